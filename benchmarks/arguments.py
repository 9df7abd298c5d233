"""The command line of a benchmark: its --help is the script's docstring."""

import argparse

REQUIRED = object()


def arguments(doc, **positional):
    """The parsed positional arguments, by name; each has a default, or is REQUIRED."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in positional.items():
        if default is REQUIRED:
            parser.add_argument(name)
        else:
            parser.add_argument(name, nargs="?", default=default)
    return parser.parse_args()
