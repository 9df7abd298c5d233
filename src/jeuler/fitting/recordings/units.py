"""Quantity and unit from a column's name.

A table of some sixty units rather than pint: what a header says is not a unit expression but a name with a unit
somewhere in it ("Time (s) Run #2", "x_mm", "t / ms", "gFx"), most of the work is to find it, and pint takes longer to
import than a recording to read.
"""

from __future__ import annotations

import math
import os
import re

G = 9.80665

UNITS: dict[str, tuple[str, float]] = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sekunden", "secondes"), ("time", 1.0)),
    **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds"), ("time", 1e-3)),
    **dict.fromkeys(("us", "µs", "usec", "micros", "microsecond", "microseconds"), ("time", 1e-6)),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanosecond", "nanoseconds"), ("time", 1e-9)),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), ("time", 60.0)),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), ("time", 3600.0)),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), ("position", 1.0)),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), ("position", 1e-2)),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), ("position", 1e-3)),
    **dict.fromkeys(("um", "µm", "micron", "microns"), ("position", 1e-6)),
    **dict.fromkeys(("nm",), ("position", 1e-9)),
    **dict.fromkeys(("km",), ("position", 1e3)),
    **dict.fromkeys(("in", "inch", "inches"), ("position", 0.0254)),
    **dict.fromkeys(("ft", "foot", "feet"), ("position", 0.3048)),
    **dict.fromkeys(("px", "pix", "pixel", "pixels"), ("position", math.nan)),
    **dict.fromkeys(("m/s", "mps"), ("velocity", 1.0)),
    "cm/s": ("velocity", 1e-2),
    "mm/s": ("velocity", 1e-3),
    **dict.fromkeys(("km/h", "kph"), ("velocity", 1 / 3.6)),
    **dict.fromkeys(("px/s", "pixels/s"), ("velocity", math.nan)),
    "m/s^2": ("acceleration", 1.0),
    "cm/s^2": ("acceleration", 1e-2),
    "mm/s^2": ("acceleration", 1e-3),
    "mg": ("acceleration", 1e-3 * G),
    **dict.fromkeys(("rad", "radian", "radians"), ("angle", 1.0)),
    "mrad": ("angle", 1e-3),
    **dict.fromkeys(("deg", "°", "degree", "degrees", "grad"), ("angle", math.pi / 180)),
    **dict.fromkeys(("rev", "turn", "turns"), ("angle", 2 * math.pi)),
    **dict.fromkeys(("rad/s", "radps", "radian/s", "radians/s"), ("angular velocity", 1.0)),
    **dict.fromkeys(("deg/s", "°/s", "dps", "degps", "degrees/s"), ("angular velocity", math.pi / 180)),
    "rpm": ("angular velocity", math.pi / 30),
    "rad/s^2": ("angular acceleration", 1.0),
    **dict.fromkeys(("deg/s^2", "°/s^2"), ("angular acceleration", math.pi / 180)),
    **dict.fromkeys(("n", "newton", "newtons"), ("force", 1.0)),
    "mn": ("force", 1e-3),
    "kn": ("force", 1e3),
    **dict.fromkeys(("kg",), ("mass", 1.0)),
    **dict.fromkeys(("v", "volt", "volts"), ("voltage", 1.0)),
    "mv": ("voltage", 1e-3),
    **dict.fromkeys(("°c", "k", "°f"), ("temperature", 1.0)),
    **dict.fromkeys(("pa", "hpa", "kpa", "bar"), ("pressure", 1.0)),
    **dict.fromkeys(("t", "mt", "µt", "ut"), ("magnetic field", 1.0)),
    **dict.fromkeys(("hz", "khz", "1/s"), ("frequency", 1.0)),
    **dict.fromkeys(("%", "db", "lx", "lux", "j", "w", "a", "ma"), ("other", 1.0)),
}
NO_SUFFIX = ("a", "A", "t", "T", "h", "n", "v", "k", "K", "w", "j")  # after "_" these are rather names than units
GRAVITIES = ("g", "gs", "gn", "g0", "g-force", "gforce")
SI = {
    "time": "s",
    "position": "m",
    "velocity": "m/s",
    "acceleration": "m/s^2",
    "angle": "rad",
    "angular velocity": "rad/s",
    "angular acceleration": "rad/s^2",
    "force": "N",
    "mass": "kg",
}

# The first pattern that the name without its unit matches, in lower case.
QUANTITIES = (
    (
        "uncertainty",
        r"\b(uncertainty|error|err|sigma|std|stdev|deviation|unsicherheit|fehler)\b|[±δ]|^d[xyz]$|^s[xyz]$",
    ),
    ("absolute", r"\b(absolute|abs|absolut\w*|magnitude|norm|total|resultant|betrag|tgf)\b|^\|.*\|$|^[avr]?mag$"),
    ("index", r"^(index|idx|row|frame|frames|sample|samples|no\.?|nr\.?|#|n|i|id|counter|count|unnamed.*|scan)$"),
    ("angular acceleration", r"\b(angular|winkel)\s*-?(acceleration|beschleunigung)\b|^alpha$"),
    ("angular velocity", r"\b(angular|winkel)\s*-?(velocity|speed|rate|geschwindigkeit)\b|\b(gyro\w*|rotation rate)\b"),
    ("angular velocity", r"^(omega|ω)([^a-z]|$)|^gyr?o?[\s_.-]*[xyz]$|^w[xyz]$"),
    ("acceleration", r"acceler|\bacc(el)?([^a-z]|$)|beschleunigung|^a(cc)?[\s_.-]*[xyz]\d*$|^gf[xyz]$|^a\d*$"),
    ("velocity", r"velocit|\bspeed\b|\bvel([^a-z]|$)|geschwindigkeit|vitesse|^v[\s_.-]*[xyz]?\d*$|^vel[\s_.-]*[xyz]?$"),
    ("time", r"^(t|time|zeit|temps|tiempo|tempo|clock|timestamp|date|datum|datetime|uhrzeit)([^a-z]|$)|\btime$"),
    (
        "time",
        r"^x_value$|^(elapsed|seconds|millis|micros|sec|ms|seconds[\s_]elapsed|epoch)([^a-z]|$)|\b(time|timestamp|zeit)\b",
    ),
    ("angle", r"\b(angle|winkel|theta|phi|pitch|roll|yaw|auslenkwinkel)\b|^(theta|θ|phi|φ|angle)([^a-z]|$)"),
    ("force", r"\b(force|kraft|tension|load)\b|^f[xyz]?$"),
    ("mass", r"^(mass|masse|weight)\b"),
    ("position", r"\b(position|pos|displacement|distance|height|elongation|extension|abstand|ort|weg|höhe)\b"),
    ("position", r"\b(auslenkung|deflection|deplacement|coordinate|ultrasonic)\b|^[xyz]($|[^a-z])|^[xyz][a-z]?\d*$"),
    ("position", r"^(pos|disp|dist)([^a-z]|$)|[_\s:.-][xyz]\d*$"),
)
_SUPERSCRIPT = str.maketrans(
    {"²": "^2", "³": "^3", "⁻": "^-", "¹": "1", "μ": "µ", "·": ".", "⋅": ".", "∙": ".", "º": "°"}
)
_POWER = {"ms^-1": "m/s", "ms^-2": "m/s^2", "m.s^-1": "m/s", "m.s^-2": "m/s^2", "rads^-1": "rad/s", "rad.s^-1": "rad/s"}
_POWER |= {spelling.replace("^", ""): unit for spelling, unit in _POWER.items()}
_RUN = re.compile(
    r"\b(?:run|data ?set|trial|take|lauf|messung|durchgang)\s*[#:]?\s*(\d+)\b\s*:?|\b(latest)\s*:", re.IGNORECASE
)


def unit_of(text: str) -> tuple[str, float] | None:
    """Quantity and factor to SI of a unit such as "mm", "[m/s²]" or "(ms)"; None if it is not known."""
    key = text.strip().strip("[](){}").strip().translate(_SUPERSCRIPT).replace("**", "^").replace(" ", "")
    key = key.replace("s^2)", "s^2").replace("/s/s", "/s^2").replace("s2", "s^2").replace("s^-^2", "s^-2")
    key = key.replace("^-^", "^-").replace("*", ".").replace("sec^", "s^").replace("/sec", "/s")
    for spelling in (key, key.lower()):
        spelling = _POWER.get(spelling, spelling)
        if spelling in GRAVITIES:
            return "acceleration", G
        if spelling in UNITS:
            return UNITS[spelling]
    return None


def is_unit(text: str) -> bool:
    """Whether a cell is a unit, in brackets or not."""
    return unit_of(text) is not None


def split_unit(name: str) -> tuple[str, str]:
    """A name without its unit, and the unit as it stands there, "" for none: "x (mm)", "t / ms", "x_mm", "Time [s]"."""
    for group in reversed(list(re.finditer(r"\(([^()]*)\)|\[([^\[\]]*)\]", name))):
        inside = group.group(1) if group.group(1) is not None else group.group(2)
        if is_unit(inside):
            rest = name[: group.start()] + " " + name[group.end() :]
            return " ".join(rest.split()), inside.strip()
    for pattern in (r"(.*\S)\s*/\s*([^\s/]+(?:/[^\s/]+)?)", r"(.*\w)[\s_]+in[\s_]+(\S+)", r"(.+),\s*(\S+)"):
        found = re.fullmatch(pattern, name.strip())
        if found and is_unit(found.group(2)) and not is_unit(name):
            return found.group(1).strip(), found.group(2)
    found = re.fullmatch(r"(.*[A-Za-z0-9])_((?:[munk]|µ)?[A-Za-z°]+\d?)", name.strip())
    if found and is_unit(found.group(2)) and found.group(2) not in NO_SUFFIX:
        return found.group(1), found.group(2)
    return name.strip(), ""


def split_run(name: str) -> tuple[str, str]:
    """A name without the run it belongs to, and the run: "Time (s) Run #2", "Data Set 1:Position(m)", "Latest: x"."""
    found = _RUN.search(name)
    if not found:
        return name, ""
    rest = " ".join((name[: found.start()] + " " + name[found.end() :]).split()).strip(" ,:-")
    return (rest, found.group(1) or "latest") if rest else (name, "")


def quantity_of(name: str) -> str:
    """The quantity that a name tells, its unit left aside; "" if none."""
    base = split_unit(split_run(name)[0])[0].lower().strip("\"' ")
    spaced = base.replace("_", " ")
    for quantity, pattern in QUANTITIES:
        if re.search(pattern, base) or re.search(pattern, spaced):
            return quantity
    return ""


def file_quantity(source: str) -> str:
    """The quantity of columns x, y, z that a file's name tells, where each sensor has a file of its own; "" if none."""
    name = os.path.basename(source).lower()
    return "acceleration" if "acceler" in name else "angular velocity" if "gyro" in name else ""


def axis_of(name: str) -> tuple[str, str]:
    """The axis that a name tells, x, y, z or "", and what tells one particle from another: "x_A", "x2", "ay"."""
    base = split_unit(split_run(name)[0])[0].strip().lower()
    found = re.match(r"(?:[av]|acc|vel|pos|gf|gyro?|w)?[\s_.-]*([xyz])[\s_.-]*(\d*|[a-z]?|[\s_]\w+)$", base)
    if found:
        return found.group(1), found.group(2).strip("_ .-")
    found = re.match(r"(.*?)[\s_.:-]+([xyz])(\d*)$", base)
    if found:
        lead = re.sub(r"[^a-z0-9]+", " ", found.group(1)).strip()
        marker = "" if quantity_of(lead) or quantity_of(lead.split(" ")[0] if lead else "") else lead
        return found.group(2), found.group(3) or marker
    return "", ""
