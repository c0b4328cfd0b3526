"""The reference of the scenario file, in the terminal and on the site: each key in it is accepted, and each accepted key is in it."""

import copy
import importlib.util
import math
import re
from pathlib import Path

import pytest
import tomli_w
from typer.testing import CliRunner

from strapdown import scenarios
from strapdown.checks import InputError
from strapdown.cli import app
from strapdown.files import tables
from strapdown.scenarios import keys

DOCS = Path(__file__).parents[1] / "docs"


def documented():
    """Return the module of the documentation."""
    if not (DOCS / "toml_reference.py").exists():
        pytest.skip("the documentation is not in this distribution")
    spec = importlib.util.spec_from_file_location("toml_reference", DOCS / "toml_reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SECTIONS = keys.sections()
NAMES = [f"{section.header} {section.type}".strip() for section in SECTIONS]
TABLES = {"motion", "gyro", "temperature", "sensors", "base", "vibration"}
"""Keys that hold tables: headers of the keys."""


def _required(section):
    return {key.name: key.example for key in section.keys if key.default == "required"}


def _least(section):
    """Return a scenario with the fewest keys that holds the section, and the table in it that the section is."""
    scenario = {"rate_hz": 10.0, "duration_s": 2.0, "motion": {"type": "rest"}, "gyro": {}}
    table = {**({"type": section.type} if section.type else {}), **_required(section)}
    match section.header:
        case "top of the file":
            return scenario, scenario
        case "[motion]":
            scenario["motion"] = table
            if section.type == "composed":
                table.update(base={"type": "rest"}, vibration={"type": "rest"})
        case "[[motion.harmonics]]":
            scenario["motion"] = {"type": "harmonic-rates", "harmonics": [table]}
        case "[gyro]" | "[temperature]":
            scenario[section.header.strip("[]")] = table
        case "[gyro.temperature]":
            scenario["gyro"], scenario["temperature"] = {"temperature": table}, {"start_degc": 20.0, "end_degc": 30.0}
        case "[[sensors]]":
            if section.type == "horizon":
                table["orbit"] = _required(SECTIONS[NAMES.index("[sensors.orbit]")])
            scenario["sensors"] = [table]
        case "[sensors.orbit]":
            magnetometer = {"type": "magnetometer", "name": "m", "sigma_nt": 1.0, "rate_hz": 1.0, "orbit": table}
            scenario["sensors"] = [magnetometer]
    return scenario, table


def _refusal(section, key, value, **others):
    """Return the message by which the parser refuses a key of this section; empty if it accepts it."""
    scenario, table = _least(section)
    table.update(others)
    table[key] = copy.deepcopy(value)
    try:
        scenarios.scenario_from_toml(tomli_w.dumps(scenario))
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("section", SECTIONS, ids=NAMES)
def test_every_key_of_the_reference_is_accepted_with_its_default(section):
    for key in section.keys:
        assert _refusal(section, key.name, key.example) == ""
        for other in key.others:
            table_keys = {k for k in _required(section) if k == key.name}
            if not table_keys:  # a required quantity in a second unit would be given twice
                assert _refusal(section, other, key.example) == ""
            else:
                assert "a second time" in _refusal(section, other, key.example)


@pytest.mark.parametrize("section", SECTIONS, ids=NAMES)
def test_every_accepted_key_is_in_the_reference(section):
    refusal = _refusal(section, "no_such_key", 1.0)
    if section.header == "[gyro]":
        refusal = _refusal(section, "no_such_key", 1.0, preset="stim300")
    accepted = set(re.search(r"\(known: (.*)\)", refusal)[1].split(", "))
    assert accepted - TABLES == {name for key in section.keys for name in (key.name, *key.others)}


DEGREE, ARCSECOND = math.pi / 180.0, math.pi / 648_000.0
SI = {"deg": DEGREE, "arcsec": ARCSECOND, "mrad": 1e-3, "deg_per_s": DEGREE, "deg_per_hour": ARCSECOND, "ppm": 1e-6}
SI |= {"nt": 1e-9} | dict.fromkeys(("ratio", "s", "hz", "m", "degc", "rad", "rad_per_s", "m_per_s2", "t"), 1.0)


def test_every_unit_of_a_key_is_converted_to_si():
    choices = [choice for name, choice in vars(tables).items() if name.isupper() and isinstance(choice, tuple)]
    factors = [(suffix, factor) for choice in choices for suffix, factor in choice if suffix]
    assert {suffix for suffix, _ in factors} == set(SI)
    for suffix, factor in factors:
        assert factor == pytest.approx(SI[suffix], rel=1e-15), suffix


def test_every_section_and_key_is_printed():
    page = "\n".join(documented().markdown(group) for group in ("top", "motion", "gyro", "sensors"))
    printed = set(re.findall(r"<code class=\"key\">([a-z0-9_]+)</code>", page.replace("<wbr>", "")))
    for section in SECTIONS:
        assert f"`{section.header}`" in page or section.group == "top"
        assert f'type = "{section.type}"' in page or not section.type
        assert {name for key in section.keys for name in (key.name, *key.others)} <= printed


def test_every_type_of_motion_and_sensor_of_the_parser_is_in_the_reference():
    for table, header in (({"motion": {"type": "?"}}, "[motion]"), ({"sensors": [{"type": "?"}]}, "[[sensors]]")):
        scenario = {"rate_hz": 10.0, "duration_s": 2.0, "motion": {"type": "rest"}, **table}
        with pytest.raises(InputError) as refused:
            scenarios.scenario_from_toml(tomli_w.dumps(scenario))
        known = {section.type for section in SECTIONS if section.header == header} - {""}
        assert known
        assert set(re.findall(r"[a-z][a-z-]+", str(refused.value).split("one of")[-1])) >= known


def test_every_printed_key_has_a_meaning():
    for group in ("top", "motion", "gyro", "sensors"):
        rows = [row.split(" | ") for row in documented().markdown(group).splitlines() if row.startswith("| <code")]
        assert rows
        for key, *_, meaning in rows:
            assert len(meaning.strip(" |").split()) >= 2, f"{group}: {key} has no docstring"


def test_every_kind_of_measurement_that_a_meaning_names_is_accepted():
    for section in SECTIONS:
        for key in section.keys:
            if key.name == "kind":
                words = re.findall(r'`"([a-z]+)"`', key.meaning)
                assert len(words) >= 2
                assert all(_refusal(section, key.name, word) == "" for word in words)


def test_the_keys_are_printed_by_section():
    gyro = ("# angle_random_walk_deg_per_sqrt_hour = 0.0", "default zeros. Constant bias, body axes.", "a |w|")
    for name, *words in (("coning", "frequency_hz = 1.0"), ("gyro", *gyro), ("horizon", "Name of the sensor")):
        result = CliRunner().invoke(app, ["keys", name])
        assert result.exit_code == 0, result.output
        assert all(word in result.output for word in words)
        assert max(map(len, result.output.splitlines())) <= 88
    every = CliRunner().invoke(app, ["keys"]).output
    assert all(section.header in every for section in SECTIONS)
    with pytest.raises(InputError, match=r"no section 'gyros' .* name one of top, motion, gyro, sensors"):
        keys.named("gyros")
    with pytest.raises(InputError, match=r"harmonic-rates, motion\.harmonics, .*temperature.*, sensors\.orbit$"):
        keys.named("gyros")
    assert [section.header for section in keys.named("harmonics")] == ["[[motion.harmonics]]"]


SYMBOLS = {"": "", "degc": "°C", "kg_m2": "kg m²", "rad_s_per_m": "rad s/m", "deg_per_hour_per_hour": "°/h²"}
SYMBOLS |= {"deg_per_hour_per_sqrt_hour": "°/h/√h", "nt": "nT", "ratio": "1", "m_per_s2": "m/s²"}


@pytest.mark.parametrize("ending", SYMBOLS)
def test_the_ending_of_a_key_stands_for_a_unit(ending):
    assert keys.symbol(ending) == SYMBOLS[ending]
