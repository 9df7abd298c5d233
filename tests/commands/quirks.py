"""Synthetic recordings with the quirks of real exports; truth: mass 0.25 kg, ks = 20 N/m, kd = 0.05 N s/m."""

import numpy as np

MASS, KS, KD, REST = 0.25, 20.0, 0.05, 0.3
DECAY = KD / (2 * MASS)
OMEGA = np.sqrt(KS / MASS - DECAY**2)
T = np.arange(250) * 0.04


def swing(t=T, amplitude=0.05, phase=0.4, noise=2e-4, seed=0):
    """The position, m."""
    clean = REST + amplitude * np.exp(-DECAY * t) * np.cos(OMEGA * t + phase)
    return clean + noise * np.random.default_rng(seed).standard_normal(len(t))


def acceleration(t=T, amplitude=0.05, phase=0.4, noise=0.02, seed=0):
    """The acceleration, m/s^2."""
    s = -DECAY + 1j * OMEGA
    clean = (amplitude * s**2 * np.exp(s * t + 1j * phase)).real
    return clean + noise * np.random.default_rng(seed).standard_normal(len(t))


def table(*columns, separator=",", form="{:.6f}", point="."):
    """Rows of text; NaN is an empty cell."""
    rows = zip(*columns, strict=True)
    cells = ((form.format(x).replace(".", point) if np.isfinite(x) else "" for x in row) for row in rows)
    return "".join(separator.join(row) + "\n" for row in cells)


def padded(x, rows=250):
    return np.concatenate([x, np.full(rows - len(x), np.nan)])


def three_runs():
    """Runs side by side of 200, 250 and 150 rows, with velocity and acceleration beside."""
    names, columns = [], []
    for k, (rows, amplitude, phase) in enumerate([(200, 0.02, 0.3), (250, 0.05, 1.0), (150, 0.03, 2.0)], 1):
        x = swing(T[:rows], amplitude, phase, seed=k)
        v = np.gradient(x, 0.04)
        for name, column in [
            ("Time (s)", T[:rows]),
            ("Position (m)", x),
            ("Velocity (m/s)", v),
            ("Acceleration (m/s²)", np.gradient(v, 0.04)),
        ]:
            names.append(f'"{name} Run #{k}"')
            columns.append(padded(column))
    return "\ufeff" + ";".join(names) + "\n" + table(*columns, separator=";", point=",")


def recordings():
    """Name of the file, its bytes, the columns that a person wants."""
    x, noise = swing(), np.random.default_rng(5).standard_normal(250) * 1e-3
    v = np.gradient(x, 0.04)
    a = np.gradient(v, 0.04)
    accelerations = [0.05 * acceleration(seed=1), acceleration(seed=2), 0.05 * acceleration(seed=3)]
    short = T[:120], x[:120]
    stamps = "".join(f"2024-05-17 16:38:{t:06.3f},{y:.6f}\n" for t, y in zip(T, x, strict=True))
    missing = table(T, np.where(np.arange(250) % 17 == 5, np.nan, x)).replace(",\n", ",#N/A\n")
    return {
        "tracker.txt": ("mass_A\nt\tx\ty\t\n" + table(T, x, 0.1 + noise / 10, separator="\t"), ["x", "y"]),
        "blanks_tabs.txt": ("t       y\n" + table(T, x, separator="\t"), ["y"]),
        "percent.txt": ("% t x v\n" + table(T, x, v, separator="  "), ["x"]),
        "pasco.csv": (three_runs(), ["Position (m) Run #2"]),
        "vernier.csv": (
            "Data Set 1:Time(s),Data Set 1:Position(m),Data Set 1:Velocity(m/s),Data Set 1:Acceleration(m/s²)\n"
            + table(T, x, v, a),
            ["Data Set 1:Position(m)"],
        ),
        "phyphox.csv": (
            '"Time (s)","Linear Acceleration x (m/s^2)","Linear Acceleration y (m/s^2)",'
            '"Linear Acceleration z (m/s^2)","Absolute acceleration (m/s^2)"\n'
            + table(T, *accelerations, np.sqrt(sum(c**2 for c in accelerations)), form="{:.9E}"),
            [f"Linear Acceleration {axis} (m/s^2)" for axis in "xyz"],
        ),
        "millimetres.csv": ("\ufeffTime (s),X (mm)\n" + table(T, 1000 * x), ["X (mm)"]),
        "milliseconds.csv": ("Time (ms),x (m)\n" + table(1000 * T, x), ["x (m)"]),
        "stacked.csv": ("t,x\n" + table(*short) + table(T, x), ["x"]),
        "dates.csv": ("timestamp,x\n" + stamps, ["x"]),
        "excel.txt": (("t\tx\n" + table(T, x, separator="\t")).encode("utf-16"), ["x"]),
        "commas.csv": (
            '"Time (s)","Position, Ch 1+2 (m)","Position, Ch 3+4 (m)"\n' + table(T, x, noise),
            ["Position, Ch 1+2 (m)"],
        ),
        "clocks.txt": (
            "#Creator: logger\n#Time A\tPos A\tTime B\tPos B\n#[s]\t[m]\t[s]\t[m]\n"
            + table(T, x, T + 0.025, swing(T + 0.025), separator="\t"),
            ["Pos A"],
        ),
        "units.txt": (
            "Vernier Format 2\nUntitled.cmbl 3/12/2024 17:31:44 .\nData Set\nTime\tPosition\nt\tx\ns\tm\n\n"
            + table(T, x, separator="\t"),
            ["Position"],
        ),
        "missing.csv": ("t,x\n" + missing, ["x"]),
        "index.csv": (",Time (s),x (m)\n" + table(np.arange(250.0), T, x), ["x (m)"]),
    }


def write(folder):
    """Write all of them."""
    for name, (content, _) in recordings().items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
