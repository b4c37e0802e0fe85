"""What the cells of a text file mean: numbers, times, words for a missing value.

A decision is made once: which mark is the decimal one holds for the file, the form of a clock for
its column. A cell that does not follow it is no number, and is named.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from functools import cache

import numpy as np
from pydantic_core import from_json

from pamctl.log.importing.measured_table import Floats, Ints

Cell = str | float
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
_PLAIN_ROWS = re.compile(r"[0-9.eE+\- \n,]*")
OTHER = {".": ",", ",": "."}


@cache
def _number_pattern(decimal: str) -> re.Pattern[str]:
    groups = rf"[0-9]{{1,3}}(?:([{OTHER[decimal]}{_GROUP_MARKS}])[0-9]{{3}})(?:\1[0-9]{{3}})*"
    body = rf"(?:(?:{groups}|[0-9]+)(?:[{decimal}][0-9]*)?|[{decimal}][0-9]+)"
    return re.compile(rf"[+-]?{body}(?:[eE][+-]?[0-9]+)?")


def read_number(cell: Cell, decimal: str) -> float | None:
    """Return the number in a cell; None for any other text. Groups have three digits each."""
    if not isinstance(cell, str):
        return float(cell)
    text = cell.strip().replace("\N{MINUS SIGN}", "-")
    if _number_pattern(decimal).fullmatch(text):
        plain = re.sub(rf"[{OTHER[decimal]}{_GROUP_MARKS}]", "", text)
        return float(plain.replace(decimal, "."))
    return _INFINITE.get(text.lower())


def read_numbers(
    cells: Sequence[Cell], decimal: str, missing: Collection[str]
) -> tuple[Floats, list[int]]:
    """Return the numbers in cells, shape (n,), NaN for any other; and which are not `missing`."""
    try:
        text = "\n".join(cells)  # type: ignore[arg-type]
    except TypeError:  # a sheet's cells may be numbers
        text = ""
    plain = read_plain_rows(text, "", decimal, 1)
    if plain is not None and len(plain) == len(cells):
        return plain[:, 0], []
    found = [read_number(cell, decimal) for cell in cells]
    lost = (at for at, value in enumerate(found) if value is None)
    bad = [at for at in lost if _word(cells[at]) not in missing]
    return np.array(found, np.float64), bad


def read_plain_rows(text: str, delimiter: str, decimal: str, width: int) -> Floats | None:
    """Return lines of plain numbers, shape (n, width); None for any other text.

    Such lines are nearly JSON, whose reader is three times as fast as others, but stricter.
    """
    other = OTHER[decimal]
    if delimiter == decimal or (other in text and other != delimiter):
        return None
    text = text.replace(decimal, ".")
    if delimiter == " ":
        text = "\n".join([",".join(line.split()) for line in text.split("\n")])
    elif delimiter:
        text = text.replace(delimiter, ",")
    if not _PLAIN_ROWS.fullmatch(text) or "+-" in text:
        return None
    if "+" in text:
        text = text.removeprefix("+").replace(",+", ",").replace("\n+", "\n")
    raw = np.frombuffer(f"{text}\n".encode(), np.uint8)
    ends = raw[(raw == ord(",")) | (raw == ord("\n"))] == ord("\n")
    if np.count_nonzero(ends) * width != len(ends) or not ends[width - 1 :: width].all():
        return None
    text = text.replace("\n", ",")
    try:
        try:
            values = np.fromiter(from_json(f"[{text}]"), np.float64)
        except ValueError:  # .5 and 007 are no JSON
            values = np.fromiter(map(float, text.split(",")), np.float64)
    except (ValueError, OverflowError):
        return None
    return values.reshape(-1, width)


def _word(cell: Cell) -> str:
    return str(cell).strip().lower()


class DecimalMark:
    """Finds which mark is the decimal one, from all cells that it is shown."""

    def __init__(self, decimal: str = "") -> None:
        self.decimal = decimal
        self._proofs: dict[str, str] = {}
        self._ambiguous: dict[str, str] = {}
        self._whole = False
        self._chosen = ""
        self.doubt = ""
        """Why the mark is not clear; nothing where it is."""

    def take(self, lines: Sequence[int] | Ints, cells: Sequence[Cell]) -> None:
        """Look at cells, which may be any text, in these lines."""
        texts = [cell.strip() if isinstance(cell, str) else "" for cell in cells]
        together = "".join(texts)
        if not self._whole:
            self._whole = any(text.isdecimal() for text in texts)
        if "." not in together and "," not in together:
            return
        for line, text in zip(lines, texts, strict=True):
            match = _MARKED.fullmatch(text)
            if match is None:
                continue
            before, marked, power = match[1], match[2], match[3]
            marks, digits = re.findall("[.,]", marked), re.split("[.,]", marked)[1:]
            place = f"{text!r} in line {line}"
            if len(marks) > 1:
                grouped = marks[0] if len(set(marks)) == 1 else None
                decimal = OTHER[grouped] if grouped else marks[-1]
                if read_number(text, decimal) is not None:
                    self._proofs.setdefault(decimal, place)
            elif len(digits[0]) == 3 and 1 <= len(before) <= 3 and before[0] != "0" and not power:
                self._ambiguous.setdefault(marks[0], place)
            else:
                self._proofs.setdefault(marks[0], place)

    @property
    def is_proved(self) -> bool:
        """Whether a cell shows which mark it is, or the user said so."""
        return bool(self.decimal or self._proofs)

    def choose(self) -> str:
        """Return the mark as far as it is known, and put what is not clear into `doubt`."""
        if self.decimal:
            return self.decimal
        proofs, unclear = self._proofs, next(iter(self._ambiguous.values()), "")
        decimal = next(iter(proofs or self._ambiguous), ".")
        if len(proofs) > 1:
            self.doubt = (
                f"{proofs['.']} has a decimal point, {proofs[',']} a decimal comma; "
                "write one of them in the whole file"
            )
        elif proofs and self._chosen not in ("", decimal):
            self.doubt = (
                f"{unclear} was read as a fraction, but {proofs[decimal]} shows that it is "
                "thousands: say decimal in the map"
            )
        elif not proofs and (len(self._ambiguous) > 1 or (unclear and self._whole)):
            self.doubt = (
                f"{unclear} may be thousands or a fraction, and no other number tells: say decimal "
                "in the map"
            )
        else:
            self.doubt = ""
        if proofs or unclear:
            self._chosen = self._chosen or decimal
        return decimal


_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_DATE = (
    r"(?:(?P<iso>\d{4}[-/.]\d{1,2}[-/.]\d{1,2})|(?P<dots>\d{1,2}\.\d{1,2}\.\d{4})"
    r"|(?P<slashes>\d{1,2}/\d{1,2}/\d{2}(?:\d\d)?)"
    r"|(?P<words>\d{1,2}[- ][A-Za-z]{3}[- ]\d{4}|[A-Za-z]{3} \d{1,2},? \d{4}))"
)
_CLOCK = re.compile(
    rf"(?:{_DATE}(?:T|[\s,]+))?(?:(?P<days>\d+)\s*d(?:ays?)?,?\s+)?"
    r"(?P<h>\d{1,4}):(?P<m>\d\d?)(?::(?P<s>\d\d?)(?:[.,](?P<f>\d*)|:(?P<ms>\d{3}))?)?"
    r"(?P<short>[.,]\d+)?\s*(?P<half>[AaPp]\.?[Mm]\.?)?\s*(?P<zone>Z|UTC|GMT|[+-]\d\d:?\d\d)?",
    re.ASCII,
)
_COMPACT = re.compile(r"^(\d{4})(\d\d)(\d\dT\d\d)(\d\d)(\d\d)", re.ASCII)
_ONLY_DATE = re.compile(_DATE, re.ASCII)
_ORDERS = {"iso": (0, 1, 2), "dots": (2, 1, 0), "slashes": (2, 0, 1), "words": (2, 1, 0)}
"""Where year, month and day stand; of `slashes` the order of the last two is not known."""
_ZEROS = str.maketrans("123456789", "000000000")
_MOST_DIGITS = 17
DAY_S = 86400.0
_TWO_PARTS = ("", True, False, False, False)
"""Hours and minutes, or minutes and seconds."""


def _spread(text: str) -> str:
    """Return `20260504T120000` as `2026-05-04T12:00:00`, any other text as it is."""
    return _COMPACT.sub(r"\1-\2-\3:\4:\5", text)


def _match_clock(text: str) -> re.Match[str] | None:
    return _CLOCK.fullmatch(text) or _ONLY_DATE.fullmatch(text)


def tell_kind(cell: Cell) -> str:
    """Return what a cell seems to be: `n`umber, `t`ime, `d`ate, `m`issing, or a `w`ord."""
    if not isinstance(cell, str):
        return "n"
    if _word(cell) in MISSING:
        return "m"
    if read_number(cell, ".") is not None or read_number(cell, ",") is not None:
        return "n"
    match = _match_clock(_spread(cell.strip()))
    return "w" if match is None else "t" if match.groupdict().get("h") else "d"


class ClockColumn:
    """Reads the times of one column, all of one form, and counts their seconds."""

    def __init__(self) -> None:
        self.first = ""
        """A time of the form that all must have."""
        self.date_form = ""
        """`iso`, `dots`, `slashes`, `words`; nothing for times without a date."""
        self._form: tuple[object, ...] | None = None
        self._is_minutes = False

    def read(self, cells: Sequence[Cell], missing: Collection[str]) -> tuple[Floats, list[int]]:
        """Return seconds and dates, shape (n, 2), NaN for a missing time; and which are none.

        Times that differ in their digits alone are read together.
        """
        groups: dict[str, list[int]] = {}
        texts = [str(cell).strip().replace("\n", " ") for cell in cells]
        if _COMPACT.match(texts[0]):
            texts = [_spread(text) for text in texts]
        for at, form in enumerate("\n".join(texts).translate(_ZEROS).split("\n")):
            groups.setdefault(form, []).append(at)
        gone = {word.translate(_ZEROS) for word in missing}
        found = np.full((len(cells), 2), np.nan)
        bad: list[int] = []
        for form, group in groups.items():
            if form.lower() in gone:
                group = [at for at in group if texts[at].lower() not in missing]
            if group:
                found[group] = self._read_alike(form, [texts[at] for at in group])
                bad += [group[at] for at in np.flatnonzero(np.isnan(found[group, 0]))]
        return found, sorted(bad)

    def _read_alike(self, form: str, texts: list[str]) -> Floats:
        """Return seconds and dates, shape (n, 2); NaN for what is no time, or of another form."""
        found = np.full((len(texts), 2), np.nan)
        match = _match_clock(form)
        part = match.groupdict("") if match else {}
        date = next((name for name in _ORDERS if part.get(name)), "")
        is_short = bool(part.get("short"))
        if match is None or (is_short and (part["s"] or date)):
            return found
        shape = (date, *(bool(part.get(name)) for name in ("h", "s", "half", "zone")))
        if self._form is None:
            self._form, self.first, self.date_form = shape, texts[0], date
        if shape != self._form:
            return found
        signs = np.array(texts).view(np.uint32).reshape(len(texts), -1)

        def count(begin: int, end: int) -> Ints:
            places = [at for at in range(begin, end) if form[at] == "0"][:_MOST_DIGITS]
            digits = signs[:, places].astype(np.int64) - ord("0")
            number: Ints = digits @ 10 ** np.arange(len(places))[::-1]
            return number

        good = np.ones(len(texts), bool)
        dates = np.full(len(texts), -1)
        if date:
            begin, end = match.span(date)
            runs = [count(begin + run.start(), begin + run.end())
                    for run in re.finditer("0+", form[begin:end])]  # fmt: skip
            if date == "words":
                name = "".join(filter(str.isalpha, part["words"])).lower()
                month = _MONTHS.index(name) + 1 if name in _MONTHS else 0
                runs.insert(1, np.full(len(texts), month))
            year, month_of, day = (runs[at] for at in _ORDERS[date])
            dates = (year + 2000 * (year < 100)) * 10000 + month_of * 100 + day
            most = 31 if date == "slashes" else 12
            good = (month_of >= 1) & (month_of <= most) & (day >= 1) & (day <= 31)
        seconds = np.zeros(len(texts))
        if part.get("h"):
            hour, minute, second = (count(*match.span(name)) for name in ("h", "m", "s"))
            good &= (minute < 60) & (second < 60)
            if self._form == _TWO_PARTS:
                self._is_minutes |= is_short or bool((hour > 23).any())
                hour, minute, second = 0 * hour, hour, minute
            if part["half"]:
                hour = hour % 12 + 12 * (part["half"][0] in "pP")
            fraction = match.span(next((n for n in ("f", "ms", "short") if part[n]), "f"))
            places = min(form[slice(*fraction)].count("0"), _MOST_DIGITS)
            zone = count(*match.span("zone"))
            away = (zone // 100 * 60 + zone % 100) * (-1 if "-" in part["zone"] else 1)
            seconds = count(*match.span("days")) * DAY_S + hour * 3600.0 + second
            seconds += (minute - away) * 60.0 + count(*fraction) / 10.0**places
        found[good] = np.column_stack([seconds, dates])[good]
        return found

    @property
    def is_date(self) -> bool:
        """Whether its cells are dates without a time."""
        return self._form is not None and not self._form[1]

    def finish(self, times: Floats, order: str, days: Floats | None) -> Floats:
        """Return seconds since the first day's midnight, shape (n,); NaN for a missing time.

        `times`, shape (n, 2), are all that were read; `days`, shape (n,), those of a column
        beside a clock without dates. Raise ValueError where the form has two readings and the
        times do not tell which is right.
        """
        seconds = times[:, 0]
        if self._form == _TWO_PARTS and not self._is_minutes:
            raise ValueError(
                f"{self.first!r} may be hours and minutes, or minutes and seconds; write the "
                "seconds too"
            )
        if self.date_form:
            days = self.count_days(times, order)
        if days is None:
            with np.errstate(invalid="ignore"):
                days = np.cumsum(np.diff(seconds, prepend=seconds[:1]) < -0.5 * DAY_S)
        return seconds + DAY_S * days

    def count_days(self, times: Floats, order: str) -> Floats:
        """Return the days since the first one, shape (n,); raise ValueError as `finish` does."""
        dates = np.nan_to_num(times[:, 1], nan=-1.0).astype(np.int64)
        if len(dates) and (dates == dates[0]).all():
            return np.zeros(len(dates))
        year, one, other = dates // 10000, dates // 100 % 100, dates % 100
        possible = []
        if self.date_form != "slashes" or order != "d/m/y":
            possible.append(_make_days(year, one, other))
        if self.date_form == "slashes" and order != "m/d/y":
            possible.append(_make_days(year, other, one))
        found = [days for days in possible if days is not None]
        smooth = [days for days in found if np.isin(np.diff(days[dates >= 0]), (0, 1)).all()]
        found = smooth if len(smooth) == 1 else found
        if not found and self.date_form != "slashes":
            raise ValueError("a date is none, as the 31st of February")
        if not found or any(not np.array_equal(found[0], days, equal_nan=True) for days in found):
            raise ValueError(
                f"{self.first!r} does not tell day from month: say date_order in the map"
            )
        return found[0]


def _make_days(year: Ints, month: Ints, day: Ints) -> Floats | None:
    """Return the days since the first date, shape (n,); None where one is no date."""
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
