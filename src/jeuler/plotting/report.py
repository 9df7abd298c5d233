"""A fit as one HTML file: every figure in it, nothing fetched from anywhere."""

from __future__ import annotations

import dataclasses
import html
import io
import os
import re
from collections.abc import Iterator, Sequence
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from jeuler._core.files import write_text
from jeuler.plotting.fits import in_unit, plain_text, plot_fit
from jeuler.plotting.residuals import plot_correlation, plot_history, plot_net, plot_residual

MOST_POINTS = 1500  # of a column in a figure: what is denser is thinned
MOST_COLUMNS = 6
MOST_ROWS, SHORT_TABLE = 400, 12

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 60rem; margin: 0 auto;
  padding: 1rem 1.2rem 4rem; }
h1 { font-size: 1.5rem; margin: 1rem 0 .3rem; } h2 { font-size: 1.1rem; margin: 2.2rem 0 .5rem; }
.verdict { font-size: 1.05rem; margin: .2rem 0 1rem; }
.warning { border-left: 4px solid #d55e00; background: #fdf3ec; padding: .5rem .8rem; margin: .5rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; } .wide { overflow-x: auto; }
th, td { text-align: left; padding: .25rem .9rem .25rem 0; border-bottom: 1px solid #e3e3e3; }
td.number, th.number { text-align: right; } td.number, td.unit { white-space: nowrap; }
th { font-weight: 600; } caption { text-align: left; color: #555; }
figure { margin: .5rem 0; } svg { max-width: 100%; height: auto; } p.note { color: #555; font-size: .9rem; }
"""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A row of the table: value, standard error (inf: not determined; None: none was found), unit, and a note."""

    name: str
    value: float
    stderr: float | None = None
    unit: str = ""
    note: str = ""

    @property
    def cells(self) -> tuple[str, str, str, str, str, str]:
        """As text: name, value, error, interval of 95 %, unit, note."""
        if self.stderr is None or not np.isfinite(self.stderr):
            why = "not determined by the data" if self.stderr is not None else ""
            return self.name, f"{self.value:.6g}", "", "", self.unit, "; ".join(filter(None, (why, self.note)))
        low, high = self.value - 1.96 * self.stderr, self.value + 1.96 * self.stderr
        return self.name, f"{self.value:.6g}", f"{self.stderr:.2g}", f"{low:.6g} to {high:.6g}", self.unit, self.note


@dataclasses.dataclass(frozen=True)
class Net:
    """A net of springs and what to colour it by: ``{"ks [N/m]": (spring,), ...}``."""

    position: Any
    edges: Any
    values: dict[str, Any]
    pinned: Any = None


@dataclasses.dataclass(frozen=True)
class Shown:
    """Readings of one kind over time, which share an axis.

    Attributes:
      times: (time,), s.  observed, predicted: (time, column); NaN = not observed.
      names, unit: of the columns.  quantity: what they are, such as "position".
      whose: which recordings they are from; "" where there is one.
    """

    times: Any
    observed: Any
    predicted: Any
    names: Sequence[str]
    unit: str = "m"
    quantity: str = "position"
    whose: str = ""

    def __post_init__(self) -> None:
        shape = np.shape(self.observed)
        if np.shape(self.predicted) != shape or shape != (len(self.times), len(self.names)):
            raise ValueError(
                f"observed and predicted must be (time, column) = ({len(self.times)}, {len(self.names)}), "
                f"got {shape} and {np.shape(self.predicted)}"
            )

    def page(self) -> Iterator[str]:
        """Data over prediction and the residual, of the columns with the largest residuals."""
        observed, predicted = np.asarray(self.observed, float), np.asarray(self.predicted, float)
        residual = observed - predicted
        seen = np.flatnonzero(np.isfinite(residual).any(axis=0))
        size = np.nansum(residual[:, seen] ** 2, axis=0)
        shown = np.sort(seen[np.argsort(-size, kind="stable")[:MOST_COLUMNS]])
        thin = slice(None, None, max(1, -(-len(residual) // MOST_POINTS)))
        names = tuple(plain_text(self.names[k]) for k in shown)
        times = np.asarray(self.times, float)
        curves = plot_fit(times[thin], observed[thin][:, shown], predicted[thin][:, shown], names=names, unit=self.unit)
        curves.axes[0].set_ylabel(in_unit(self.quantity, self.unit))
        of = f": {self.quantity}, {self.whose}" * bool(self.whose)
        yield f"<h2>{html.escape(f'Data and fit{of}')}</h2>"
        if len(shown) < len(seen):
            yield f'<p class="note">The {len(shown)} columns of {len(seen)} with the largest residuals.</p>'
        yield _figure(curves, f"data and fit over time, and the residual{of}")
        yield f"<h2>{html.escape(f'What the fit leaves{of}')}</h2>"
        details = plot_residual(times, residual[:, shown], names=names, unit=self.unit)
        yield _figure(details, f"residual in detail{of}")


@dataclasses.dataclass(frozen=True)
class FitReport:
    """What a report of a fit shows.

    Attributes:
      title, verdict: what was fitted, and how it went, in a sentence.
      shown: the readings, one for each kind of sensor.
      parameters: the rows of the table.  warnings: sentences.  next_steps: what to do now.
      facts: (what, value) of the summary.
      correlation: names of the parameters and the matrix, or None.  history: of the loss, or None.
      net: the springs, or None.
    """

    title: str
    verdict: str
    shown: Sequence[Shown]
    parameters: Sequence[Parameter]
    facts: Sequence[tuple[str, str]] = ()
    warnings: Sequence[str] = ()
    next_steps: Sequence[str] = ()
    correlation: tuple[Sequence[str], Any] | None = None
    history: Any = None
    net: Net | None = None

    def write(self, path: str | os.PathLike[str]) -> None:
        """The page, written whole or not at all."""
        write_text(path, self.html())

    def html(self) -> str:
        """The page as text."""
        body = "\n".join(self._body())
        return (
            f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
            f'<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{html.escape(self.title)}</title><style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
        )

    def _body(self) -> Iterator[str]:
        yield f"<h1>{html.escape(self.title)}</h1>"
        yield f'<p class="verdict">{html.escape(self.verdict)}</p>'
        yield from (f'<p class="warning">{html.escape(warning)}</p>' for warning in self.warnings)
        if len(self.parameters) <= SHORT_TABLE:
            yield from self._table()
        if self.facts:
            rows = "".join(f"<tr><td>{html.escape(a)}</td><td>{html.escape(b)}</td></tr>" for a, b in self.facts)
            yield f'<h2>Summary</h2><div class="wide"><table>{rows}</table></div>'
        if self.next_steps:
            items = "".join(f"<li>{html.escape(step)}</li>" for step in self.next_steps)
            yield f"<h2>What to do next</h2><ul>{items}</ul>"
        for shown in self.shown:
            yield from shown.page()
        yield from self._net_and_search()
        if len(self.parameters) > SHORT_TABLE:
            yield from self._table()

    def _net_and_search(self) -> Iterator[str]:
        """The springs in the colours of their values, how the errors go together, and the way of the search."""
        if self.net is not None and len(self.net.edges):
            yield "<h2>The springs</h2>"
            for label, values in self.net.values.items():
                figure = plot_net(self.net.position, self.net.edges, values, label=label, pinned=self.net.pinned)
                yield _figure(figure, f"net coloured by {label}")
        if self.correlation is not None and len(self.correlation[0]) > 1:
            yield "<h2>Correlation of the errors</h2>"
            yield _figure(plot_correlation(*self.correlation), "correlation matrix of the parameters")
        if self.history is not None and len(self.history):
            yield "<h2>The search</h2>"
            yield _figure(plot_history(self.history), "loss against iteration")

    def _table(self) -> Iterator[str]:
        head = ("parameter", "value", "standard error", "95 % interval", "unit", "")
        numbers = (1, 2, 3)
        yield "<h2>Parameters</h2>"
        yield '<div class="wide"><table><tr>'
        yield "".join(f"<th{_right(k in numbers)}>{name}</th>" for k, name in enumerate(head)) + "</tr>"
        for parameter in self.parameters[:MOST_ROWS]:
            kinds = ("", *("number",) * 3, "unit", "")
            pairs = zip(kinds, parameter.cells, strict=True)
            cells = (f'<td class="{kind}">{html.escape(cell)}</td>' for kind, cell in pairs)
            yield f"<tr>{''.join(cells)}</tr>"
        yield "</table></div>"
        if len(self.parameters) > MOST_ROWS:
            yield f'<p class="note">and {len(self.parameters) - MOST_ROWS} more</p>'


def _right(number: bool) -> str:
    return ' class="number"' if number else ""


def _figure(figure: Figure, words: str) -> str:
    """A figure as SVG within the page."""
    text = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": words}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    plt.close(figure)
    drawn = text.getvalue()
    drawn = re.sub(r"<metadata>.*?</metadata>", "", drawn[drawn.index("<svg") :], flags=re.DOTALL)
    unique = re.sub(r"\W+", "-", words)
    drawn = re.sub(r'\bid="([^"]+)"', rf'id="{unique}-\1"', drawn)
    drawn = re.sub(r'(href="#|url\(#)', rf"\g<1>{unique}-", drawn)
    label = html.escape(words, quote=True)
    return drawn.replace("<svg", f'<figure><svg role="img" aria-label="{label}"', 1) + "</figure>"
