"""Wrong inputs drawn from a table, API and command line: told in one line, none taken in silence.

All of them: ``python benchmarks/slips.py``.
"""

import slips


def test_calls_that_are_wrong_are_told_in_one_line():
    found = {name: slips.tried(call) for name, call in slips.calls(150, seed=1).items()}
    assert {name: what for name, what in found.items() if what not in ("told", "warned")} == {}


def test_commands_that_are_wrong_are_one_line_and_exit_code_2(tmp_path):
    lines = slips.commands(60, tmp_path, seed=1)
    found = {name: slips.commanded(line, tmp_path) for name, line in lines.items()}
    assert {name: what for name, what in found.items() if what != "told"} == {}


def test_right_calls_pass():
    """What the wrong calls are made of is right: no slip is told for another reason than its own."""
    expensive = ("fit", "advise", "work_precision", "identifiability", "read_trajectory", "stability_limit", "diagnose")
    for name, (function, arguments) in slips.RIGHT.items():
        if not name.startswith(expensive):
            function(**{key: right for key, (_, right) in arguments.items()})


def test_what_came_is_told_apart():
    def numpy_error():
        raise TypeError("unhashable")

    assert slips.tried(lambda: 1) == "silent: int"
    assert slips.tried(numpy_error).startswith("raw: TypeError")
