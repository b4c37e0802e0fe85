"""The columns of a log that stays in its file: chunks are decoded again where they are read."""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.log.paging.grid_rows import GridRows

PAGE_TICKS = 1 << 14
"""Ticks that are decoded together: some megabytes."""
_KEPT_PAGES = 3
WALL_TIME = "/time_ns"

Page = Mapping[str, NDArray[Any]]


class Pages(Mapping[str, Any]):
    """The columns by name; each is read as `column[i]`, `column[a:b]` or `np.asarray(column)`."""

    def __init__(
        self, none: Page, rows: list[int], grid: GridRows, decode: Callable[[int], Page]
    ) -> None:
        """`rows` are the first rows of the pages, `decode` reads the page of such a number.

        `none` has the columns without ticks, each of its type. A page has the wall times beside
        its columns, under the name `WALL_TIME`.
        """
        self.grid = grid
        """Which row holds which tick."""
        self._none = none
        self._rows, self._decode = rows, decode
        self._kept: OrderedDict[int, Page] = OrderedDict()

    def __getitem__(self, name: str) -> PagedColumn:
        return PagedColumn(self, name, self._none[name].dtype)

    def __iter__(self) -> Iterator[str]:
        return iter(self._none)

    def __len__(self) -> int:
        return len(self._none)

    @property
    def time_ns(self) -> Any:
        """The wall time of each tick."""
        return PagedColumn(self, WALL_TIME, np.dtype(np.uint64))

    def cut(self, begin: int, end: int) -> Iterator[tuple[Page, slice]]:
        """Yield the pages that hold some rows, with the place of those rows in each."""
        while begin < end:
            number = bisect_right(self._rows, begin) - 1
            first = self._rows[number]
            last = self._rows[number + 1] if number + 1 < len(self._rows) else self.grid.count
            yield self._read(number), slice(begin - first, min(end, last) - first)
            begin = last

    def _read(self, number: int) -> Page:
        if number in self._kept:
            self._kept.move_to_end(number)
            return self._kept[number]
        page = self._kept[number] = self._decode(number)
        if len(self._kept) > _KEPT_PAGES:
            self._kept.popitem(last=False)
        return page


class PagedColumn:
    """One column. To read all of it at once takes as long as to read the log."""

    def __init__(self, pages: Pages, name: str, dtype: np.dtype[Any]) -> None:
        """Read the column `name` of `pages`."""
        self._pages, self._name = pages, name
        self.dtype = dtype

    def __len__(self) -> int:
        return self._pages.grid.count

    def __getitem__(self, at: int | slice) -> Any:
        """Return one value, or the values of a slice without gaps as an array."""
        if not isinstance(at, slice):
            row = range(len(self))[at]
            return self[row : row + 1][0]
        begin, end, step = at.indices(len(self))
        assert step == 1, "a slice without gaps"
        parts = [page[self._name][where] for page, where in self._pages.cut(begin, end)]
        return parts[0] if len(parts) == 1 else np.concatenate([np.empty(0, self.dtype), *parts])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the whole column."""
        whole: NDArray[Any] = np.asarray(self[:], dtype)
        return whole
