"""From names, files and overrides to settings, and every error in the user's words."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from pydantic import BaseModel, Field, TypeAdapter, ValidationError, model_validator
from support.command_line import run_process
from typer.testing import CliRunner

from hal.calibration import Configured
from pamctl.base.errors import ConfigError
from pamctl.cli.app import app
from pamctl.settings.config_files import config_dir, find_config_file
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    RunSettings,
    check_config_file,
    from_resolved,
    resolve,
    settings_to_json,
    settings_to_yaml,
    validate_settings,
)

SCHEMA_LINE = "# yaml-language-server: $schema=../pamctl.schema.json"


# --- a toy with every shape that a settings model may take -------------------------------


class Sliding(Configured):
    law: Literal["sliding"]
    lambda_per_s: float = Field(gt=0, le=1000)
    limit_v: float = Field(default=5.0, ge=0)
    pressure_pa: float = 1e5
    taps: tuple[float, float] = (0.0, 1.0)
    cutoff_hz: float | Literal["auto"] = "auto"
    cycles: int = 1
    literal: bool = True
    notes: str | None = None
    offsets_v: dict[str, float] = Field(default={})
    c: float = 1.0
    k: float = 1.0


class Pid(Configured):
    law: Literal["pid"] = "pid"
    kp_v_per_m: float = 1.0


class Limits(Configured):
    low_m: float = Field(default=0.0, ge=-1, le=1)
    high_m: float = 1.0

    @model_validator(mode="after")
    def _ordered(self) -> Limits:
        if self.low_m >= self.high_m:
            raise ValueError("low_m must lie below high_m")
        return self


class Toy(Configured):
    controller: Annotated[Sliding | Pid, Field(discriminator="law")]
    limits: Limits | None = None
    steps: list[Limits] = Field(default=[])


TOY = TypeAdapter(Toy)


@pytest.fixture(autouse=True)
def _in_tmp_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def toy_problems(text: str, *overrides: str) -> list[str]:
    Path("my.yaml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        toy(RawSettings.read(Path("my.yaml")), *overrides)
    return str(caught.value).splitlines()


def toy(raw: RawSettings, *overrides: str) -> Toy:
    for override in overrides:
        raw.override(override)
    return validate_settings(TOY, raw)


SLIDING = "controller:\n  law: sliding\n  lambda_per_s: 225\n"


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("limit_v: -2", "limit_v: must be at least 0 (got -2)"),
        ("limit_v: .nan", "limit_v: must be a finite number (got .nan)"),
        ("limit_v: -.inf", "limit_v: must be a finite number (got -.inf)"),
        ("limit_v: true", "limit_v: must be a number (got true)"),
        ("limit_v:", "limit_v: must be a number (got nothing)"),
        ("limit_v: '5'", "limit_v: must be a number (got '5'); leave out the quotes"),
        ("limit_v: 2,5", "limit_v: must be a number (got '2,5'); write the decimals after a point"),
        (
            "limit_v: 5 V",
            "limit_v: must be a number (got '5 V'); a bare number, in the unit that the key names",
        ),
        ("limit_v: {a: 1}", "limit_v: must be a number (got a mapping)"),
        ("cycles: 1.5", "cycles: must be a whole number (got 1.5)"),
        ("cycles: true", "cycles: must be a whole number (got true)"),
        (
            "literal: on",
            "literal: must be true or false (got 'on'); YAML 1.2 knows only true and false",
        ),
        ("notes: 3", "notes: must be text (got 3)"),
        ("taps: [1, 2, 3]", "taps: must hold at most 2 items (got 3)"),
        ("taps: [1]", "taps: must hold more than 1 item"),
        ("taps: [1, x]", "taps.1: must be a number (got 'x')"),
        ("taps: 1", "taps: must be a list (got 1)"),
        ("cutoff_hz: fast", "cutoff_hz: must be a number or 'auto' (got 'fast')"),
        ("offsets_v: {a: b}", "offsets_v.a: must be a number (got 'b')"),
        ("offsets_v:", "offsets_v: must be a mapping of keys to values (got nothing); leave the"),
        ("limitv: 1", "limitv: unknown key; did you mean 'limit_v'?"),
        ("lamda: 1", "lamda: unknown key; did you mean 'lambda_per_s'?"),
        (
            "pressure_kpa: 1",
            "pressure_kpa: unknown key; did you mean 'pressure_pa'? The unit is part of the name",
        ),
        ("pressure: 1", "pressure: unknown key; did you mean 'pressure_pa'? The unit is part of"),
        ("k_v: 1", "k_v: unknown key; did you mean 'k'? The unit is part of the name"),
        ("zzz: 1", "zzz: unknown key; there are law, lambda_per_s, limit_v, pressure_pa, taps,"),
    ],
)
def test_a_bad_value_is_one_line_with_its_place_and_what_was_expected(line, problem):
    (said,) = toy_problems(f"{SLIDING}  {line}\n")
    assert said.startswith("my.yaml:4:")
    assert f": controller.{problem}" in said


def test_a_key_with_another_unit_is_one_problem_not_an_unknown_and_a_missing_one():
    assert toy_problems("controller:\n  law: sliding\n  lambda_hz: 35\n") == [
        "my.yaml:3:3: controller.lambda_hz: unknown key; "
        "did you mean 'lambda_per_s'? The unit is part of the name"
    ]


def test_an_unknown_or_missing_tag_of_a_union_lists_the_choices():
    assert toy_problems("controller:\n  law: slidin\n") == [
        "my.yaml:2:3: controller.law: must be 'sliding' or 'pid' (got 'slidin')"
    ]
    assert toy_problems("controller: {}\n") == [
        "my.yaml:1:1: controller.law: missing; it must be 'sliding' or 'pid'"
    ]
    assert toy_problems("controller: 3\n") == [
        "my.yaml:1:1: controller: must be a mapping of keys to values (got 3)"
    ]


def test_all_problems_of_a_file_come_at_once_in_the_order_of_its_lines():
    lines = toy_problems(f"{SLIDING}  cycles: x\n  limit_v: -1\nlimits: 3\nstep: []\n")
    assert [line.split(": ")[0] for line in lines] == [
        "my.yaml:4:3",
        "my.yaml:5:3",
        "my.yaml:6:1",
        "my.yaml:7:1",
    ]


JARGON = ("input", "Input", "extra", "permitted", "instance", "tag", "Field required", "model")


@given(
    data=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text("abc1. ", max_size=5),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(
                    [
                        "controller",
                        "law",
                        "limits",
                        "steps",
                        "low_m",
                        "taps",
                        "cutoff_hz",
                        "offsets_v",
                        "q",
                    ]
                ),
                inner | st.sampled_from(["sliding", "pid"]),
                max_size=4,
            )
        ),
        max_leaves=12,
    )
)
@examples(max_examples=60, deadline=None)
def test_pydantics_jargon_never_reaches_the_user(data):
    mapping = data if isinstance(data, dict) else {"controller": data}
    try:
        toy(RawSettings(mapping, {(): "my.yaml:1:1"}))
    except ConfigError as error:
        said = str(error)
    else:
        return
    assert not [word for word in JARGON if word in said]
    assert all(line.startswith("my.yaml:1:1: ") for line in said.splitlines())


# --- overrides ---------------------------------------------------------------------------


def test_an_override_takes_a_scalar_or_a_flow_value_and_makes_the_mappings_on_its_way():
    made = toy(
        RawSettings.parse(f"{SLIDING}steps: [{{low_m: 0}}]\n", Path("my.yaml")),
        "controller.lambda_per_s=1e1",
        "controller.taps=[3, 4]",
        "limits.low_m=-0.5",
        "steps.0={low_m: 0.25}",
        "controller.notes=a = b",
    )
    assert isinstance(made.controller, Sliding)
    assert made.controller.lambda_per_s == 10.0
    assert made.controller.taps == (3.0, 4.0)
    assert made.controller.notes == "a = b"
    assert made.limits == Limits(low_m=-0.5)
    assert made.steps == [Limits(low_m=0.25)]


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("controller.lambda_per_s=0", "controller.lambda_per_s: must be greater than 0 (got 0)"),
        ("controller.lamda_per_s=1", "controller.lamda_per_s: unknown key; did you mean 'lambda_p"),
        ("controler.limit_v=1", "controler: unknown key; did you mean 'controller'?"),
        ("limits.low_m=7", "limits.low_m: must be at most 1 (got 7)"),
        ("limits={low_m: 7}", "limits.low_m: must be at most 1 (got 7)"),
        ("controller.law.x=1", "controller.law.x: 'controller.law' holds no keys"),
        ("steps.3.low_m=0", "steps.3.low_m: 'steps' has no item 3; it holds 0"),
        ("controller.taps=[1", "controller.taps: a bracket or brace is never closed"),
        ("controller", "must read KEY=VALUE, as in controller.lambda_per_s=12"),
        ("controller..x=1", "must read KEY=VALUE, as in controller.lambda_per_s=12"),
    ],
)
def test_a_bad_override_is_reported_as_the_override_and_not_as_the_file(override, problem):
    (said,) = toy_problems(f"{SLIDING}steps: []\n", override)
    assert said.startswith(f"--set {override}: {problem}")


# --- round trip --------------------------------------------------------------------------


@given(
    st.floats(1e-300, 1000, exclude_min=True),
    st.floats(0, allow_infinity=False),
    st.text(st.characters(exclude_categories=["Cs"])),
)
@examples(deadline=None)
def test_settings_come_back_equal_from_yaml_and_from_json(rate, limit, notes):
    gains = Sliding(law="sliding", lambda_per_s=rate, limit_v=limit, notes=notes)
    made = Toy(controller=gains, steps=[Limits(low_m=1e-05)])
    for text in (settings_to_yaml(made), settings_to_json(made)):
        assert toy(RawSettings.parse(text, Path("log"))) == made


# --- the shipped files -------------------------------------------------------------------


def shipped() -> Iterator[Path]:
    for section in SECTIONS:
        yield from sorted((config_dir() / section).glob("*.yaml"))


def test_every_shipped_file_names_the_schema_and_is_valid():
    assert list(shipped())
    for path in shipped():
        assert path.read_text().splitlines()[0] == SCHEMA_LINE, path
    code, out, err = config("check")
    assert (code, err) == (0, "")
    kinds = [line.rpartition(": ")[2] for line in out.splitlines()]
    assert kinds == [f"ok ({path.parent.name})" for path in shipped()]


def test_the_committed_schema_is_the_printed_one_and_complete():
    committed = json.loads((config_dir() / "pamctl.schema.json").read_text())
    code, out, _ = config("schema")
    assert code == 0
    assert json.loads(out) == committed, "run: pamctl config schema > config/pamctl.schema.json"
    used = {part.split('"')[0] for part in json.dumps(committed).split('"#/$defs/')[1:]}
    assert used <= set(committed["$defs"])
    assert len(committed["anyOf"]) > len(SECTIONS)


def _models(model: type[BaseModel], seen: set[type[BaseModel]]) -> set[type[BaseModel]]:
    """Every settings model that can be reached from one, through unions and containers."""

    def within(annotation: Any) -> None:
        is_model = isinstance(annotation, type) and issubclass(annotation, BaseModel)
        if is_model and annotation not in seen:
            _models(annotation, seen)
        for argument in getattr(annotation, "__args__", ()):
            within(argument)

    seen.add(model)
    for field in model.model_fields.values():
        within(field.annotation)
    return seen


def test_every_settings_model_is_strict_and_its_defaults_are_those_of_its_parts():
    """Otherwise an override of one key of a nested model would silently change the others."""
    for model in _models(RunSettings, set()):
        assert issubclass(model, Configured), model.__name__
        for name, field in model.model_fields.items():
            default = field.get_default(call_default_factory=True, validated_data={})
            if type(None) in getattr(field.annotation, "__args__", ()):
                assert default is None, f"{model.__name__}.{name}"
            if isinstance(default, BaseModel):
                assert default == type(default)(), f"{model.__name__}.{name}"


# --- resolving a run ---------------------------------------------------------------------


def test_a_run_without_options_is_the_default_run_and_comes_back_equal_from_its_log():
    run = resolve()
    assert run == from_resolved(settings_to_yaml(run)) == from_resolved(settings_to_json(run))
    assert run.seed == 0
    with pytest.raises(ValidationError):
        run.seed = 1  # type: ignore[misc]


@cache
def default_run() -> RunSettings:
    return resolve()


def test_a_bad_option_is_reported_by_its_name():
    with pytest.raises(ConfigError) as caught:
        resolve(seed=-1, duration_s=0.0, rt="always")
    assert str(caught.value).splitlines() == [
        "--seed -1: seed: must be at least 0 (got -1)",
        "--duration 0.0: duration_s: must be greater than 0 (got 0.0)",
        "--rt always: rt: must be 'auto', 'require' or 'off' (got 'always')",
    ]


def test_problems_of_several_files_come_at_once():
    Path("my.yaml").write_text("base: papr\n")
    Path("other.yaml").write_text("backend: nidaq\n")
    with pytest.raises(ConfigError) as caught:
        resolve(plant="my.yaml", rig="other.yaml")
    assert str(caught.value).splitlines() == [
        "other.yaml:1:1: rig.safe_volts: missing, and has no default "
        "(output V that is safe: 0 vents, driver_offset_v holds)",
        "my.yaml:1:1: plant.base: must be 'paper' (got 'papr')",
    ]
    with pytest.raises(ConfigError) as caught:
        resolve(plant="none.yaml", controller="nobody")
    assert [problem.where for problem in caught.value.problems] == [
        "--controller nobody",
        "none.yaml",
    ]


def test_an_unknown_name_gets_the_nearest_and_the_list():
    with pytest.raises(ConfigError) as caught:
        find_config_file("plant", "papr")
    assert str(caught.value).startswith(
        "--plant papr: there is no such plant; did you mean 'paper'? There are ball-screw, paper"
    )
    with pytest.raises(ConfigError, match="there is no such controller"):
        resolve(controller="")  # an empty shell variable is not the default
    assert find_config_file("plant", "paper") == config_dir() / "plant" / "paper.yaml"
    assert find_config_file("plant", "here/paper") == Path("here/paper")


def test_a_resolved_configuration_that_no_longer_fits_names_itself():
    with pytest.raises(ConfigError) as caught:
        from_resolved('{"seed": -1}', "run.mcap")
    assert "run.mcap: seed: must be at least 0 (got -1)" in str(caught.value).splitlines()


def test_the_kind_of_a_file_follows_from_its_folder_or_its_keys():
    Path("rig").mkdir()
    for name, text in {
        "rig/mine.yaml": "backend: sim\n",
        "plant.yaml": "base: paper\n",
        "motion.yaml": "kind: tracking\ncycles: 1\n",
        "resolved.yaml": settings_to_yaml(default_run()),
    }.items():
        Path(name).write_text(text)
    kinds = [
        check_config_file(Path(name)) for name in ("rig/mine.yaml", "plant.yaml", "motion.yaml")
    ]
    assert kinds == ["rig", "plant", "experiment"]
    assert check_config_file(Path("resolved.yaml")) == "run"
    Path("what.yaml").write_text("colour: red\n")
    with pytest.raises(ConfigError, match=r"what\.yaml: cannot tell what this configures"):
        check_config_file(Path("what.yaml"))


def test_a_file_with_the_heading_of_its_section_is_refused_with_the_fix():
    Path("plant").mkdir()
    Path("plant/mine.yaml").write_text("plant:\n  base: paper\n")
    with pytest.raises(ConfigError) as caught:
        check_config_file(Path("plant/mine.yaml"))
    assert str(caught.value) == (
        "plant/mine.yaml:1:1: plant.plant: unknown key; the keys of a plant file have no heading"
    )


def test_a_plant_file_with_a_correction_table_is_refused_with_what_to_do():
    Path("plant").mkdir()
    Path("plant/old.yaml").write_text("correction: {pull: {displacement_m: [0, 0.02]}}\n")
    with pytest.raises(ConfigError, match=r"old.yaml:1:1: plant.correction: .*`pamctl diagnose`"):
        check_config_file(Path("plant/old.yaml"))


def test_settings_load_without_the_heavy_packages():
    heavy = ["numpy", "scipy", "matplotlib", "mcap", "nidaqmx"]
    code = f"import sys, pamctl.settings.resolve; print([m for m in {heavy} if m in sys.modules])"
    done = run_process([sys.executable, "-c", code], check=True)
    assert done.stdout.strip() == "[]"


# --- the command ---------------------------------------------------------------------------


def config(*arguments: str) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, ["config", *arguments])
    return done.exit_code, done.stdout, done.stderr


def test_config_check_lists_problems_and_exits_with_78():
    Path("bad.yaml").write_text("base: papr\n")
    Path("good.yaml").write_text("base: paper\n")
    code, out, _ = config("check", "bad.yaml", "good.yaml", "none.yaml")
    assert code == 78
    assert out.splitlines() == [
        "bad.yaml:1:1: plant.base: must be 'paper' (got 'papr')",
        "good.yaml: ok (plant)",
        "none.yaml: no such file",
    ]
    code, out, _ = config("check", "--json", "bad.yaml", "good.yaml")
    assert code == 78
    bad, good = json.loads(out)
    assert (good["file"], good["kind"], good["ok"]) == ("good.yaml", "plant", True)
    assert bad["problems"] == [
        {"where": "bad.yaml:1:1", "key": "plant.base", "message": "must be 'paper' (got 'papr')"}
    ]


def test_config_show_prints_what_the_run_would_use():
    options = ("--set", "plant.parameters.mass_kg=0.1", "--seed", "3")
    expected = resolve(overrides=["plant.parameters.mass_kg=0.1"], seed=3)
    for form in ((), ("--json",)):
        code, out, _ = config("show", *options, *form)
        assert code == 0
        assert from_resolved(out) == expected


def test_config_show_knows_the_backend_as_run_does():
    code, out, _ = config("show", "--backend", "nidaq", "--json")
    assert code == 0
    assert from_resolved(out) == resolve(rig="pci6221")
    code, _, err = config("show", "--backend", "sim", "--rig", "pci6221")
    assert code == 2
    assert "for the backend nidaq" in err


@pytest.mark.parametrize(
    ("override", "says"),
    [
        (
            "controller.law=pid",
            "for 'qsmc' and has its keys; choose another file with --controller",
        ),
        ("rig.backend=nidaq", "another file with --rig (axis, pci6221, pci6221-comedi, sim)"),
        ("experiment.kind=steps", "choose another file with --experiment"),
    ],
)
def test_an_override_cannot_change_the_law_or_backend_or_kind_of_a_file(override, says):
    with pytest.raises(ConfigError) as caught:
        resolve(overrides=[override])
    (problem,) = caught.value.problems
    assert says in problem.message
    key, _, value = override.partition("=")
    chosen = {"controller.law": "qsmc", "rig.backend": "sim", "experiment.kind": "tracking"}
    resolve(
        overrides=[f"{key}={chosen[key]}"]
    )  # a value that the file states already may be repeated
    assert value not in chosen.values()


def test_config_show_keeps_problems_off_stdout():
    code, out, err = config("show", "--set", "plant.parameters.mass_kg=-1")
    assert (code, out) == (78, "")
    assert err == (
        "--set plant.parameters.mass_kg=-1: plant.parameters.mass_kg: "
        "must be at least 1e-09 (got -1)\n"
    )
    heavy = config("show", "--set", "plant.parameters.mass_kg=1e9")
    assert heavy[0] == 78
    assert "must be at most 1e+06" in heavy[2]
    assert config("show", "--no-such-option")[0] == 2


def test_a_key_without_its_section_is_refused_with_the_section():
    with pytest.raises(ConfigError, match=r"did you mean 'controller\.lambda_per_s'\?"):
        resolve(overrides=["lambda_per_s=30"])
