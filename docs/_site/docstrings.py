"""Docstrings of this project as reStructuredText.

They are one sentence, an equation indented by four, text, and sections: ``Args:`` and ``Attributes:`` with a line a
name, ``Returns:``, ``Raises:`` and ``Source:`` with their text behind the colon, ``Example:`` with a doctest. Names are
between backticks. Nothing else is markup, so that ``|v|`` and ``a * b`` may be written as they are.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

LISTS = re.compile(r"(Args|Attributes|Fields):$")
TEXTS = re.compile(r"(Returns|Raises|Source):\s+(.*)$")
ITEM = re.compile(r"([*\w][\w, *]*): (.*)$")
LITERAL = re.compile(r"(``.+?``|`[^`]+`)")
EQUATION = ".. code-block:: text", ""
TITLES = {"Args": "Parameters"}


def inline(text: str) -> str:
    """A line with its names as literals, and nothing else taken for markup."""
    parts = LITERAL.split(text)
    parts[::2] = [re.sub(r"([\\*|])|(?<=\w)(_)(?!\w)", lambda m: "\\" + m.group(0), part) for part in parts[::2]]
    parts[1::2] = [f"``{part.strip('`')}``" for part in parts[1::2]]
    return "".join(parts)


def indent_of(line: str) -> int:
    return len(line) - len(line.lstrip())


def sections(lines: list[str]) -> Iterator[list[str]]:
    """The docstring cut into sections, and what stands outside of them into paragraphs and equations."""
    block: list[str] = []
    for line in lines:
        head = indent_of(line) == 0 and (LISTS.match(line) or TEXTS.match(line) or line == "Example:")
        after_blank = bool(block) and not block[-1].strip()
        inside = bool(block) and (LISTS.match(block[0]) or TEXTS.match(block[0]) or block[0] == "Example:")
        if block and line.strip() and (head or (after_blank and (not inside or indent_of(line) == 0))):
            yield block
            block = []
        if line.strip() or block:
            block.append(line.rstrip())
    if block:
        yield block


def field(title: str, text: list[str]) -> list[str]:
    """A field with its text behind it; a leading initial is not the number of a list."""
    first = ("\\" if re.match(r"\w+\.\s", text[0]) else "") + inline(text[0])
    return [f":{title}: {first}", *(f"  {inline(line.strip())}" for line in text[1:] if line.strip()), ""]


def names(title: str, lines: list[str]) -> list[str]:
    """A field with a list of names and what each is."""
    found = [f":{title}:", ""]
    depth = min(indent_of(line) for line in lines if line.strip())
    for line in lines:
        item = ITEM.match(line.strip()) if indent_of(line) == depth else None
        if item:
            found += [f"  * **{inline(item.group(1))}**: {inline(item.group(2))}"]
        elif line.strip():
            found += [f"    {inline(line.strip())}"]
    return [*found, ""]


def rst(lines: list[str]) -> list[str]:
    """A docstring's lines as reStructuredText."""
    found: list[str] = []
    for block in sections(lines):
        while block and not block[-1].strip():
            block.pop()
        head = block[0]
        if listed := LISTS.match(head):
            found += names(TITLES.get(listed.group(1), listed.group(1)), block[1:])
        elif text := TEXTS.match(head):
            found += field(text.group(1), [text.group(2), *block[1:]])
        elif head == "Example:":
            depth = min(indent_of(line) for line in block[1:] if line.strip())
            found += [".. rubric:: Example", "", *(line[depth:] for line in block[1:]), ""]
        elif indent_of(head) >= 4:
            found += [*EQUATION, *(f"  {line[4:]}" for line in block), ""]
        else:
            found += [*_text(block), ""]
    return found


def _text(block: list[str]) -> Iterator[str]:
    """A paragraph or a list of points; an indented equation that follows its line at once is one too."""
    equation = False
    for line in block:
        if indent_of(line) >= 4 and not equation:
            yield from ("", *EQUATION)
            equation = True
        elif equation and indent_of(line) < 4:
            yield ""
            equation = False
        yield f"  {line[4:]}" if equation else inline(line)
