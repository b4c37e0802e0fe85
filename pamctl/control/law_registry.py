"""Which laws there are: those of installed packages, and one that a file defines for a quick try.

Nothing else in pamctl names a law. `ControllerSettings` is the union of the settings of all laws.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Annotated, Any, NamedTuple

from hal.entry_points import find_entry_points
from pamctl import __version__
from pamctl.base.chosen_model import ChosenModel, build_once
from pamctl.control.law import Law, LawSettings, LawTerms, Term, answer

GROUP = "pamctl.laws"
OWN_PACKAGE = "pamctl"
_SHIPPED = tuple(
    EntryPoint(name, f"pamctl.control.{name}:LAW", GROUP) for name in ("qsmc", "smc", "pid")
)
"""Their entry points again: an editable install that was made before them knows none."""
FILE_VARIABLE = "PAMCTL_CONTROLLER_FROM"
"""Environment variable with the law file: the processes of a run inherit it."""


class LawError(ValueError):
    """A law that is not there, or cannot be used. The message says which and why."""


@dataclass(frozen=True)
class LawOrigin:
    """Where a law comes from: what a log needs so that the same law can be found again."""

    package: str
    """Name of the installed package; empty for a law from a file."""
    version: str
    source: Path
    """The file that defines its record."""
    sha256: str
    """Of that file when the law was loaded."""

    @property
    def is_file(self) -> bool:
        """Tell whether `--controller-from` loaded it."""
        return not self.package


@dataclass
class _Registry:
    laws: dict[str, Law] = field(default_factory=dict)
    origins: dict[str, LawOrigin] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    """Why a law that is offered cannot be used, by its name."""
    file_failure: str = ""
    """Why the file that the environment names cannot be used."""

    def add(self, law: Law, package: str, version: str, source: Path) -> None:
        if law.gains in answer.registry:
            raise LawError(f"the law {law.name!r} shares its type of gains with another law")
        digest = hashlib.sha256(source.read_bytes()).hexdigest()
        self.laws[law.name] = law
        self.origins[law.name] = LawOrigin(package, version, source, digest)
        answer.register(law.gains, law.kernel)


@build_once
def _load_registry() -> _Registry:
    registry = _Registry()
    points = [p for p in find_entry_points(GROUP) if p not in _SHIPPED]
    for one in (*_SHIPPED, *points):
        package, version = OWN_PACKAGE, __version__
        if one.dist is not None:
            package, version = one.dist.name, one.dist.version
        if one.name in registry.laws:
            first = registry.origins[one.name].package
            print(
                f"warning: the law {one.name!r} of the package {package} is left out: "
                f"{first} has a law of that name",
                file=sys.stderr,
            )
            continue
        try:
            law = one.load()
            if not isinstance(law, Law) or law.name != one.name:
                raise LawError(f"{one.value} is no Law named {one.name!r}")
            source = Path(str(sys.modules[one.module].__file__))
            registry.add(law, package, version, source)
        except Exception as error:
            # One broken package must not take the other laws away.
            registry.failures[one.name] = (
                f"the package {package} offers it, but cannot be used: "
                f"{type(error).__name__}: {error}"
            )
    if os.environ.get(FILE_VARIABLE):
        try:
            _add_file(registry, os.environ[FILE_VARIABLE])
        except LawError as error:
            registry.file_failure = f"{error} ({FILE_VARIABLE})"
    return registry


def installed_laws() -> Mapping[str, Law]:
    """Return all laws by name, the shipped ones first."""
    return MappingProxyType(_load_registry().laws)


def find_law(name: str) -> Law:
    """Return the law of a name; raise `LawError` where no package offers it."""
    registry = _load_registry()
    if name not in registry.laws:
        why = explain_missing_law(name) or "the package that offers it is not installed"
        raise LawError(f"there is no law {name!r}: {why}; there are {', '.join(registry.laws)}")
    return registry.laws[name]


def explain_missing_law(name: str) -> str:
    """Return why a law that is offered cannot be used; empty where nothing offers it."""
    registry = _load_registry()
    return registry.failures.get(name, registry.file_failure)


def law_of(settings: LawSettings) -> Law:
    """Return the law that settings belong to."""
    return find_law(settings.law)


def read_controller(data: Mapping[str, Any]) -> LawSettings:
    """Validate the keys of a gains file.

    Raises `LawError` for an unknown law, and pydantic's `ValidationError` for its keys.
    """
    return find_law(str(data.get("law"))).settings.model_validate(dict(data))


def _find_settings(name: str) -> type[LawSettings] | None:
    law = installed_laws().get(name)
    return None if law is None else law.settings


ControllerSettings = Annotated[LawSettings, ChosenModel("law", installed_laws, _find_settings)]
"""The settings of any installed law; the key `law` selects the model."""


# --- what a log says of its law ------------------------------------------------------------


def describe_law(law: Law) -> dict[str, str]:
    """Return the metadata record `law` of a log: where the law is from, and its words."""
    origin = _load_registry().origins[law.name]
    if origin.is_file:
        where = {"file": str(origin.source)}
    else:
        where = {"package": origin.package, "version": origin.version, "file": origin.source.name}
    return {
        "name": law.name,
        "title": law.title,
        "equation": law.equation,
        "terms": json.dumps(law.terms._asdict()),
        **where,
        "sha256": origin.sha256,
    }


class LawWords(NamedTuple):
    """What reports call a law and its terms."""

    title: str
    equation: str
    terms: LawTerms


_UNKNOWN_TERMS = LawTerms(
    Term("surface", "m/s\u00b2"), Term("equivalent", "V"), Term("robust", "V")
)


def read_law_words(record: Mapping[str, str], name: str) -> LawWords:
    """Return the words of a log's record `law`; of an older log, those of the installed law.

    The law itself need not be installed: a log carries its words.
    """
    if "terms" in record:
        terms: dict[str, Any] = {
            column: None if words is None else Term(*words)
            for column, words in json.loads(record["terms"]).items()
        }
        return LawWords(record["title"], record["equation"], LawTerms(**terms))
    law = installed_laws().get(name)
    if law is None:
        return LawWords(name, "", _UNKNOWN_TERMS)
    return LawWords(law.title, law.equation, law.terms)


def explain_absent_law(record: Mapping[str, str], name: str) -> str:
    """Say how to get the law of a log whose metadata record `law` is given (empty in old logs).

    Returns '' where the law is there.
    """
    registry = _load_registry()
    if name in registry.laws:
        return ""
    if name in registry.failures:
        return f"the law {name!r} cannot be used: {registry.failures[name]}"
    if record.get("package"):
        return (
            f"the law {name!r} is missing: install the package {record['package']} "
            f"{record.get('version', '')}".rstrip()
        )
    if record.get("file"):
        return (
            f"the law {name!r} is missing: it was loaded from {record['file']} "
            f"(sha256 {record['sha256'][:12]}...); name that file with --controller-from"
        )
    return f"the law {name!r} is missing: install the package that offers it"


def compare_law_source(record: Mapping[str, str], name: str) -> str:
    """Say how the installed law differs from the one of a log's record `law`; '' if it does not.

    Pamctl's own laws are known by its version, which the log carries elsewhere.
    """
    origin = _load_registry().origins.get(name)
    if origin is None or "sha256" not in record or record.get("package") == OWN_PACKAGE:
        return ""
    if record["sha256"] == origin.sha256:
        return ""
    then = f"{record['package']} {record['version']}" if "package" in record else record["file"]
    now = str(origin.source) if origin.is_file else f"{origin.package} {origin.version}"
    return (
        f"the source of the law {name!r} is not the one that made the log: then {then} "
        f"(sha256 {record['sha256'][:12]}...), now {now} (sha256 {origin.sha256[:12]}...)"
    )


# --- a law from a file -----------------------------------------------------------------------


def add_law_file(spec: str) -> Law:
    """Add the law that `FILE.py` or `FILE.py:NAME` defines, for this process and its children.

    NAME is needed where the file has more than one `Law`. Raises `LawError`.
    """
    law = _add_file(_load_registry(), spec)
    os.environ[FILE_VARIABLE] = spec if Path(spec).is_absolute() else f"{Path.cwd() / spec}"
    return law


def _add_file(registry: _Registry, spec: str) -> Law:
    file, colon, name = spec.rpartition(":")
    if not colon or not name.isidentifier():
        file, name = spec, ""
    path = Path(file).resolve()
    law = _find_record(registry, _load_module(path), name, path)
    known = registry.origins.get(law.name)
    if known is not None:
        if known.is_file and known.source == path:
            return registry.laws[law.name]
        whose = known.package or str(known.source)
        raise LawError(f"{path}: {whose} has a law {law.name!r} already; choose another name")
    registry.add(law, "", "", path)
    return law


def _load_module(path: Path) -> ModuleType:
    if not path.is_file():
        raise LawError(f"{path}: there is no Python file of this name")
    # The same text is the same module wherever it lies: compiled kernels are kept by its name.
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    module_name = f"law_file_{re.sub(r'[^A-Za-z0-9]', '_', path.stem)}_{digest[:8]}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    module_spec = importlib.util.spec_from_file_location(module_name, path)
    if module_spec is None or module_spec.loader is None:
        raise LawError(f"{path}: its name does not end with .py")
    module = importlib.util.module_from_spec(module_spec)
    # Its models and pickled settings look themselves up here.
    sys.modules[module_name] = module
    try:
        module_spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[module_name]
        raise LawError(f"{path} cannot be loaded: {type(error).__name__}: {error}") from error
    return module


def _find_record(registry: _Registry, module: ModuleType, name: str, path: Path) -> Law:
    if name:
        law = getattr(module, name, None)
        if not isinstance(law, Law):
            raise LawError(f"{path} has no Law called {name}")
        return law
    installed = {id(law) for n, law in registry.laws.items() if not registry.origins[n].is_file}
    laws = {n: law for n, law in vars(module).items() if isinstance(law, Law)}
    own = {n: law for n, law in laws.items() if id(law) not in installed}
    if len(own) != 1:
        which = ", ".join(own) or "none"
        raise LawError(f"{path} must define one Law, and defines {which}; or name it: FILE.py:NAME")
    return next(iter(own.values()))
