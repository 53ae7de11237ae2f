"""Progress of long work: a bar on a terminal or in a notebook, elsewhere lines."""

from __future__ import annotations

import sys
from typing import Any

from tqdm.auto import tqdm

_IN_NOTEBOOK = any(base.__module__ == "tqdm.notebook" for base in tqdm.__mro__)


class Progress(tqdm):
    """A ``tqdm`` bar, of widgets in a notebook; plain lines into a log, a file or a pipe."""

    def __init__(
        self, iterable: Any = None, *, desc: str, show: bool = True, interval: float = 5.0, file: Any = None, **options: Any
    ) -> None:
        """Start the clock.

        Args:
            iterable: what is worked through; None for ``update`` by hand.
            show: False writes nothing anywhere.
            interval: seconds from one line to the next; shorter work writes none.
            file: text stream; standard error if None.
            options: of ``tqdm``: ``total``, ``unit``, ``initial``, ``leave``, ….
        """
        stream = sys.stderr if file is None else file
        is_terminal = hasattr(stream, "isatty") and stream.isatty()
        self._as_lines = not is_terminal and not (_IN_NOTEBOOK and file is None)
        self._interval, self._written = interval, 0
        if self._as_lines:
            options |= {"mininterval": interval, "miniters": 0, "delay": interval, "leave": False}
            options |= {"display": False} if _IN_NOTEBOOK else {}
        super().__init__(iterable, desc, file=stream, disable=not show or stream is None, **options)

    def fit_step(self, stage: str, cost: float) -> None:
        """Count a step of a fit, and show its stage and cost."""
        self.update()
        self.set_postfix_str(f"{stage}, cost {cost:.4g}")

    def refresh(self, *args: Any, **keywords: Any) -> None:
        """Redraw the bar, or write a line if the last one is ``interval`` old."""
        if not self._as_lines:
            super().refresh(*args, **keywords)
        elif not self.disable and self._now() - self.last_print_t >= self._interval:
            self._write_line()

    def close(self) -> None:
        """End the bar; lines end with one that has the final count."""
        if self._as_lines and not self.disable and self.last_print_t > self.start_t and self.n > self._written:
            self._write_line()
        super().close()

    def display(self, *args: Any, **keywords: Any) -> bool:
        """Draw the bar; lines are written by ``refresh`` alone."""
        return False if self._as_lines else bool(super().display(*args, **keywords))

    def clear(self, *args: Any, **keywords: Any) -> None:
        """Remove the bar before other text is written; lines stay."""
        if not self._as_lines:
            super().clear(*args, **keywords)

    def _now(self) -> float:
        return self.start_t + self.format_dict["elapsed"]

    def _write_line(self) -> None:
        self.last_print_t, self._written = self._now(), self.n
        elapsed, done = self.last_print_t - self.start_t, self.n - self.initial
        unit = self.unit if (self.total or self.n) == 1 else self.unit + ("es" if self.unit.endswith("s") else "s")
        text = f"{self.desc} {self.n}{f'/{self.total}' if self.total else ''} {unit}, {self.format_interval(elapsed)}"
        if self.total and 0 < self.n < self.total and done > 0:
            text += f", about {self.format_interval((self.total - self.n) * elapsed / done)} to go"
        self.fp.write(f"{text}: {self.postfix}\n" if self.postfix else f"{text}\n")
        self.fp.flush()
