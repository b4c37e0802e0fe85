"""What the cells of a text file mean: numbers, times, words for a missing value.

A decision is made once: which mark is the decimal one holds for the file, the form of a clock for
its column. A cell that does not follow it is no number, and is named.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable
from functools import cache

import numpy as np

from pamctl.log.importing.measured_table import Floats, Ints

MISSING = frozenset({
    "", "nan", "-nan", "n/a", "#n/a", "na", "n.a.", "null", "none", "missing", "-", "--", "---",
    "?", "#div/0!", "#value!", "#num!", "#null!", "#ref!", "#name?", "nan()", "1.#qnan", "-1.#ind",
    "1.#ind", "no data", "invalid", "<na>",
})  # fmt: skip
"""In small letters."""
_INFINITE = {"inf": np.inf, "+inf": np.inf, "-inf": -np.inf, "infinity": np.inf,
             "-infinity": -np.inf, "1.#inf": np.inf, "-1.#inf": -np.inf}  # fmt: skip
_GROUP_MARKS = "'\N{RIGHT SINGLE QUOTATION MARK} \N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}"
_MARKED = re.compile(r"[+-]?(\d*)((?:[.,]\d*)+)([eE][+-]?\d+)?")
OTHER = {".": ",", ",": "."}


@cache
def _number_pattern(decimal: str) -> re.Pattern[str]:
    groups = rf"[0-9]{{1,3}}(?:([{OTHER[decimal]}{_GROUP_MARKS}])[0-9]{{3}})(?:\1[0-9]{{3}})*"
    body = rf"(?:(?:{groups}|[0-9]+)(?:[{decimal}][0-9]*)?|[{decimal}][0-9]+)"
    return re.compile(rf"[+-]?{body}(?:[eE][+-]?[0-9]+)?")


def read_number(cell: str | float, decimal: str) -> float | None:
    """Return the number in a cell; None for any other text. Groups have three digits each."""
    if not isinstance(cell, str):
        return float(cell)
    text = cell.strip().replace("\N{MINUS SIGN}", "-")
    if _number_pattern(decimal).fullmatch(text):
        plain = re.sub(rf"[{OTHER[decimal]}{_GROUP_MARKS}]", "", text)
        return float(plain.replace(decimal, "."))
    return _INFINITE.get(text.lower())


class DecimalMark:
    """Finds which mark is the decimal one, from all cells that it is shown."""

    def __init__(self, decimal: str = "") -> None:
        self.decimal = decimal
        self._proofs: dict[str, str] = {}
        self._ambiguous: dict[str, str] = {}
        self._whole = False

    def take(self, line: int, cell: str | float) -> None:
        """Look at a cell, which may be any text."""
        if not isinstance(cell, str) or self.decimal:
            return
        match = _MARKED.fullmatch(cell.strip())
        if match is None:
            self._whole |= cell.strip().isdecimal()
            return
        before, marked, power = match[1], match[2], match[3]
        marks, digits = re.findall("[.,]", marked), re.split("[.,]", marked)[1:]
        place = f"{cell.strip()!r} in line {line}"
        if len(marks) > 1:
            grouped = marks[0] if len(set(marks)) == 1 else None
            decimal = OTHER[grouped] if grouped else marks[-1]
            if read_number(cell, decimal) is not None:
                self._proofs.setdefault(decimal, place)
        elif len(digits[0]) == 3 and 1 <= len(before) <= 3 and before[0] != "0" and not power:
            self._ambiguous.setdefault(marks[0], place)
        else:
            self._proofs.setdefault(marks[0], place)

    @property
    def is_proved(self) -> bool:
        """Whether a cell shows which mark it is, or the user said so."""
        return bool(self.decimal or self._proofs)

    def settle(self) -> str:
        """Return the mark; raise ValueError with the cells where it is not clear."""
        if self.decimal:
            return self.decimal
        if len(self._proofs) > 1:
            raise ValueError(
                f"{self._proofs['.']} has a decimal point, {self._proofs[',']} a decimal comma; "
                "write one of them in the whole file"
            )
        if self._proofs:
            return next(iter(self._proofs))
        if len(self._ambiguous) > 1 or (self._ambiguous and self._whole):
            cell = next(iter(self._ambiguous.values()))
            raise ValueError(
                f"{cell} may be thousands or a fraction, and no other number tells: say decimal in "
                "the map"
            )
        return next(iter(self._ambiguous), ".")


_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_DATE = (
    r"(?:(?P<iso>\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{8}(?=T))|(?P<dots>\d{1,2}\.\d{1,2}\.\d{4})"
    r"|(?P<slashes>\d{1,2}/\d{1,2}/\d{2}(?:\d\d)?)"
    r"|(?P<words>\d{1,2}[- ][A-Za-z]{3}[- ]\d{4}|[A-Za-z]{3} \d{1,2},? \d{4}))"
)
_CLOCK = re.compile(
    rf"(?:{_DATE}(?:T|[\s,]+))?(?:(?P<days>\d+)\s*d(?:ays?)?,?\s+)?"
    r"(?P<h>\d{1,4}):(?P<m>[0-5]?\d)(?::(?P<s>[0-5]?\d)(?:[.,](?P<f>\d*)|:(?P<ms>\d{3}))?)?"
    r"(?P<short>[.,]\d+)?\s*(?P<half>[AaPp]\.?[Mm]\.?)?\s*(?P<zone>Z|UTC|GMT|[+-]\d\d:?\d\d)?"
)
_COMPACT = re.compile(r"(\d{8})T(\d\d)(\d\d)(\d\d(?:[.,]\d+)?)(Z|[+-]\d\d:?\d\d)?")
_ONLY_DATE = re.compile(_DATE)
_DIGITS = re.compile(r"\d+")
_DATE_PARTS = {"iso": (0, 1, 2), "dots": (2, 1, 0), "slashes": (2, 0, 1)}
"""Where year, month and day stand; of `slashes` the order of the last two is not known."""
DAY_S = 86400.0


def tell_kind(cell: str | float, missing: frozenset[str] = MISSING) -> str:
    """Return what a cell seems to be: `n`umber, `t`ime, `d`ate, `m`issing, or a `w`ord."""
    if not isinstance(cell, str):
        return "n"
    text = cell.strip()
    if text.lower() in missing:
        return "m"
    if read_number(text, ".") is not None or read_number(text, ",") is not None:
        return "n"
    if _ONLY_DATE.fullmatch(text):
        return "d"
    return "t" if _CLOCK.fullmatch(text) or _COMPACT.fullmatch(text) else "w"


class ClockColumn:
    """Takes the times of one column, all of one form, and counts their seconds."""

    def __init__(self) -> None:
        self.form: tuple[object, ...] | None = None
        self._dates = array("q")
        self._seconds = array("d")
        self._is_minutes = False
        self.first = ""

    def take(self, cell: str | float) -> bool:
        """Take a time; return False where it is none, or of another form than the others."""
        text = str(cell).strip()
        compact = _COMPACT.fullmatch(text)
        if compact:
            day, h, m, s, zone = compact.groups()
            text = f"{day[:4]}-{day[4:6]}-{day[6:]}T{h}:{m}:{s}{zone or ''}"
        match = _CLOCK.fullmatch(text) or _ONLY_DATE.fullmatch(text)
        if match is None:
            return False
        part = match.groupdict()
        form = next((n for n in ("iso", "dots", "slashes", "words") if part[n]), "")
        shape: tuple[object, ...] = (form, "date")
        if part.get("h"):
            shape = (form, "hms" if part["s"] else "two", bool(part["half"]), bool(part["zone"]))
        if part.get("short") and (part["s"] or form):
            return False
        if self.form is None:
            self.form, self.first = shape, text
        date = _read_date(form, part[form]) if form else 0
        if shape != self.form or date is None:
            return False
        self._dates.append(date)
        self._seconds.append(self._count(part) if part.get("h") else 0.0)
        return True

    def __len__(self) -> int:
        return len(self._seconds)

    @property
    def changes(self) -> bool:
        """Whether the dates differ from each other."""
        return len(set(self._dates)) > 1

    def forget(self, count: int) -> None:
        """Forget all times but the first ones."""
        del self._dates[count:], self._seconds[count:]

    def take_many(self, cells: list[str]) -> bool:
        """Take times; return False, with some of them taken, where one is none of this form."""
        return self._take_alike(cells) or all(map(self.take, cells))

    def _take_alike(self, cells: list[str]) -> bool:
        """Take times that differ from the first in their digits alone; False for any other."""
        match = _CLOCK.fullmatch(cells[0])
        form = next((n for n in ("iso", "dots", "slashes") if match and match[n]), "")
        if match is None or not match["s"] or match["days"] or match["words"] or match["half"]:
            return False
        parts = [match.span(name) for name in ("h", "m", "s", "f" if match["f"] else "ms")]
        begin = match.start(form) if form else 0
        parts += [
            (begin + d.start(), begin + d.end())
            for d in _DIGITS.finditer(match[form] if form else "")
        ]
        width = len(cells[0])
        table = np.array(cells, f"U{width + 1}").view(np.uint32).reshape(len(cells), -1)
        digits = table.astype(np.int64) - ord("0")
        free = [at for begin, end in parts for at in range(max(begin, 0), end)]
        fixed = np.setdiff1d(np.arange(width + 1), free)  # the marks between, the zone, the end
        alike = (table[:, fixed] == table[0, fixed]).all()
        if len(parts) not in (4, 7) or not alike or (digits[:, free] // 10 != 0).any():
            return False
        h, m, s, f, *date = (
            digits[:, a:b] @ 10 ** np.arange(b - a - 1, -1, -1) if b > a else 0 * digits[:, 0]
            for a, b in parts
        )
        coded = 0 * h
        if date:
            year, month, day = (date[at] for at in _DATE_PARTS[form])
            coded = (year + 2000 * (year < 100)) * 10000 + month * 100 + day
            most = 31 if form == "slashes" else 12
            if (month > most).any() or (day > 31).any() or (month * day == 0).any():
                return False
        if (m > 59).any() or (s > 59).any() or not self.take(cells[0]):
            return False
        seconds = h * 3600.0 + m * 60.0 + s + f / 10.0 ** (parts[3][1] - parts[3][0])
        zone_s = round(self._seconds.pop() - seconds[0])
        self._dates.pop()
        self._dates.frombytes(coded.astype(np.int64).tobytes())
        self._seconds.frombytes((seconds + zone_s).tobytes())
        return True

    def skip(self) -> None:
        """Take a missing time."""
        self._dates.append(-1)
        self._seconds.append(np.nan)

    def _count(self, part: dict[str, str | None]) -> float:
        hour, minute, second = (int(part[name] or 0) for name in ("h", "m", "s"))
        fraction = part["f"] or part["ms"] or (part["short"] or "")[1:]
        if self.form is not None and self.form == ("", "two", False, False):
            self._is_minutes |= bool(part["short"]) or hour > 23
            hour, minute, second = 0, hour, minute
        if part["half"]:
            hour = hour % 12 + 12 * (part["half"][0] in "pP")
        seconds = int(part["days"] or 0) * DAY_S + hour * 3600.0 + minute * 60.0 + second
        if part["zone"] and part["zone"][0] in "+-":
            sign, digits = part["zone"][0], part["zone"][1:].replace(":", "")
            away_s = int(digits[:2]) * 3600.0 + int(digits[2:]) * 60.0
            seconds -= away_s if sign == "+" else -away_s
        return seconds + (float(f"0.{fraction}") if fraction else 0.0)

    def finish(self, order: str = "", dates: ClockColumn | None = None) -> Floats:
        """Return seconds since the first day's midnight, shape (n,); NaN for a missing time.

        `dates` is the column of dates beside a clock without. Raise ValueError where the form has
        two readings and the times do not tell which is right.
        """
        seconds = np.frombuffer(self._seconds, np.float64).copy()
        form = self.form or ("", "")
        if form == ("", "two", False, False) and not self._is_minutes:
            raise ValueError(
                f"{self.first!r} may be hours and minutes, or minutes and seconds; write the "
                "seconds too"
            )
        dated = self if form[0] else dates
        if dated is not None and dated.form is not None:
            return seconds + DAY_S * _count_days(dated, order)
        with np.errstate(invalid="ignore"):
            turned = np.diff(seconds, prepend=seconds[:1]) < -0.5 * DAY_S
        return seconds + DAY_S * np.cumsum(turned)


def _read_date(form: str, text: str | None) -> int | None:
    """Return the three parts of a date as one number, those of `slashes` in the file's order."""
    parts = re.split(r"[-/. ]", str(text)) if len(str(text)) != 8 or form != "iso" else [
        str(text)[:4], str(text)[4:6], str(text)[6:]
    ]  # fmt: skip
    if form == "words":
        if not parts[0].isdecimal():
            parts[:2] = [parts[1].strip(","), parts[0]]
        if parts[1].lower() not in _MONTHS:
            return None
        parts[1] = str(_MONTHS.index(parts[1].lower()) + 1)
    first, second, third = map(int, parts)
    if form in ("dots", "words"):
        first, second, third = third, second, first
    elif form == "slashes":
        first, second, third = third + 2000 * (third < 100), first, second
    is_date = 1 <= second <= 31 and 1 <= third <= 31 and (form == "slashes" or second <= 12)
    return first * 10000 + second * 100 + third if is_date else None


def _count_days(clock: ClockColumn, order: str) -> Floats:
    """Return the days since the first one, shape (n,)."""
    dates = np.frombuffer(clock._dates, np.int64)
    if len(dates) and (dates == dates[0]).all():
        return np.zeros(len(dates))
    year, one, other = dates // 10000, dates // 100 % 100, dates % 100
    if clock.form is not None and clock.form[0] == "slashes":
        orders: dict[str, Callable[[], Floats | None]] = {
            "m/d/y": lambda: _make_days(year, one, other),
            "d/m/y": lambda: _make_days(year, other, one),
        }
        possible = {
            name: days
            for name, make in orders.items()
            if name == (order or name) and (days := make()) is not None
        }
        smooth = [
            days for days in possible.values() if np.isin(np.diff(days[dates >= 0]), (0, 1)).all()
        ]
        found = smooth if len(smooth) == 1 else list(possible.values())
        if not found or any(not np.array_equal(found[0], days, equal_nan=True) for days in found):
            raise ValueError(
                f"{clock.first!r} does not tell day from month: say date_order in the map"
            )
        return found[0]
    days = _make_days(year, one, other)
    if days is None:
        raise ValueError("a date is none, as the 31st of February")
    return days


def _make_days(year: Ints, month: Ints, day: Ints) -> Floats | None:
    good = year >= 0
    if (month[good] > 12).any():
        return None
    months = ((year - 1970) * 12 + month - 1).astype("datetime64[M]")
    dates = months.astype("datetime64[D]") + (day - 1)
    if (dates.astype("datetime64[M]") != months)[good].any():
        return None
    days = (dates - dates[good][:1]).astype(np.float64) if good.any() else np.zeros(len(year))
    days[~good] = np.nan
    return days
