"""Where a command writes to, checked before it works."""

from __future__ import annotations

import os

from jeuler._core.files import check_output

PICTURES = (".png", ".svg", ".pdf", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".eps", ".ps")
STANDARD_OUTPUT = "-"


def check_outputs(files: list[str], asked: dict[str, str | None]) -> None:
    """Refuse, before the fit, outputs that cannot be written or that would overwrite the recording."""
    outputs = {option: path for option, path in asked.items() if path is not None and path != STANDARD_OUTPUT}
    for option, path in outputs.items():
        try:
            check_output(path)
        except ValueError as error:
            raise ValueError(f"{option} {error}") from None
        for file in files:
            if os.path.exists(file) and os.path.realpath(file) == os.path.realpath(path):
                raise ValueError(f"{option} {path}: is the measured file itself; give another name")
    if list(asked.values()).count(STANDARD_OUTPUT) > 1:
        raise ValueError(f"one output at most can be {STANDARD_OUTPUT}, standard output; give the others a name")
    plain = [(option, path) for option, path in outputs.items() if not is_stream(path)]
    for k, (option, path) in enumerate(plain):
        for other, earlier in plain[:k]:
            if os.path.realpath(path) == os.path.realpath(earlier):
                raise ValueError(f"{other} and {option} must be different files, got {path} for both")


def check_kind(picture: str) -> None:
    """One ValueError if a picture has no ending that says its kind."""
    ending = os.path.splitext(os.path.realpath(picture))[1].lower()
    if picture != STANDARD_OUTPUT and not is_stream(picture) and ending not in PICTURES:
        raise ValueError(
            f"--plot {picture}: a picture's name must end in {', '.join(PICTURES[:4])}, got {ending or 'none'!r}"
        )


def is_stream(path: str) -> bool:
    return os.path.exists(path) and not os.path.isfile(path)
