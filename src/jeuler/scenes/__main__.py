"""Pictures of the example scenes: python -m jeuler.scenes FOLDER [NAME ...]"""

import pathlib
import sys

import matplotlib
from PIL import Image

from jeuler import scenes


def main() -> None:
    if len(sys.argv) < 2 or sys.argv[1].startswith("-"):
        sys.exit(f"{__doc__}\nNAME is one of {', '.join(scene.__name__ for scene in scenes.ALL)}; all without a name")
    matplotlib.use("Agg")
    folder = pathlib.Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    names = sys.argv[2:] or [scene.__name__ for scene in scenes.ALL]
    for name in names:
        path = folder / f"{name}.png"
        getattr(scenes, name)().picture(path, size=(1024, 640))
        Image.open(path).convert("RGB").quantize(256).save(path, optimize=True)
        print(path)


if __name__ == "__main__":
    main()
