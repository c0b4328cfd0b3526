"""Files of every kind that the package reads, with the function that reads them."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import damage
import h5py
import numpy as np
from ulog_writer import write_ulog

from strapdown import coning, gyro, montecarlo, quaternion, recordings, records, scenarios
from strapdown.estimation import setup
from strapdown.montecarlo import campaign
from strapdown.montecarlo import statistics as sums
from strapdown.recordings import attitudes, recordfiles
from strapdown.report import tunings

Damage = Callable[..., bytes]


@dataclass(frozen=True)
class Target:
    """A file, its reader and the kinds of damage applied to it."""

    name: str
    """With the suffix that its reader expects."""
    content: bytes
    read: Callable[[Path], Any]
    damages: tuple[Damage, ...]
    share: float
    """Share of all damaged files."""


def targets(folder: Path) -> list[Target]:
    """Write one file of every kind to a folder; return them."""
    low = dataclasses.replace(scenarios.load_scenario("low-orbit"), duration=3.0, gyro_preset="")
    record = scenarios.simulate(low, 3, 1)
    recordfiles.write_record(folder / "record.h5", record)
    _write_estimate(folder / "estimate.h5")
    _write_campaign(folder / "campaign.h5", low)
    with h5py.File(folder / "broad.hdf5", "w") as file:
        file.attrs["sampling_rate"], file.attrs["text"] = 100.0, "of variable length"
        for name, width in (("imu_gyr", 3), ("imu_acc", 3), ("imu_mag", 3), ("opt_quat", 4)):
            file.create_dataset(name, data=np.ones((400, width)), chunks=(50, width), compression="gzip")
    rows = "".join(f"{0.01 * k:.2f},{0.1 * k},0.2,-0.3,0.1,0.2,9.8,20,{k},-40\n" for k in range(20))
    (folder / "walk.csv").write_text("time,gx [deg/s],gy [deg/s],gz [deg/s],ax [m/s2],ay,az,mx,my,mz\n" + rows)
    np.save(folder / "gyro.npy", np.arange(300.0).reshape(100, 3) * 1e-4)
    (folder / "scenario.toml").write_text(scenarios.scenario_to_toml(scenarios.load_scenario("tumbling-satellite")))
    attitude = scenarios.scenario_to_toml(scenarios.load_scenario("slew-vibration")).split("[[sensors]]")[0] + _TRACKER
    (folder / "attitude.toml").write_text(attitude)
    filter_setup = setup.FilterSetup.for_scenario(scenarios.load_scenario("hand-held"), states=True)
    (folder / "filter.toml").write_text(setup.to_toml(filter_setup) + _GATE)
    (folder / "gyro.toml").write_text(
        '[gyro]\nangle_random_walk_deg_per_sqrt_hour = 0.1\n"scale_factor_ppm" = [1, 2, 3]\n'
    )
    (folder / "dispersions.toml").write_text(
        "[dispersions]\nattitude_sigma_deg = 1.0\nbias_error_deg_per_hour = [1, 2, 3]\n"
    )
    (folder / "vibration.csv").write_text(
        "frequency_hz,angle_deg,angle_across_deg,phase_deg\n10,0.1,0.2,90\n20,0.1,0.05,80\n"
    )
    (folder / "tuning.json").write_text(json.dumps(_TUNING))

    def target(name: str, read: Callable[[Path], Any], damages: tuple[Damage, ...], share: float) -> Target:
        return Target(name, (folder / name).read_bytes(), read, damages, share)

    bytewise, structure = damage.BYTES, (damage.change_hdf5,)
    units = {"gyro": "rad/s"}
    return [
        target("record.h5", recordfiles.read_record, bytewise, 0.06),
        target("estimate.h5", setup.read_estimate, bytewise, 0.03),
        target("campaign.h5", campaign.read, bytewise, 0.06),
        target("record.h5", recordfiles.read_record, structure, 0.015),
        target("estimate.h5", setup.read_estimate, structure, 0.015),
        target("campaign.h5", campaign.read, structure, 0.015),
        target("broad.hdf5", recordings.read, structure, 0.001),
        target("walk.csv", recordings.read, damage.TEXT, 0.22),
        target("gyro.npy", lambda path: recordings.read_samples(path, rate=100.0, units=units), (*bytewise, damage.replace_word), 0.08),
        target("scenario.toml", scenarios.load_scenario, damage.TEXT, 0.04),
        target("attitude.toml", scenarios.load_scenario, damage.TEXT, 0.05),
        target("filter.toml", setup.read_setup, damage.TEXT, 0.06),
        target("gyro.toml", gyro.read_spec, damage.TEXT, 0.05),
        target("dispersions.toml", montecarlo.read_dispersions, damage.TEXT, 0.05),
        target("vibration.csv", coning.read_vibration, damage.TEXT, 0.11),
        target("tuning.json", tunings.report, (*damage.TEXT, damage.replace_node, damage.replace_node), 0.12),
        *foreign(folder),
    ]  # fmt: skip


FOREIGN = {"bag": 0.03, "mcap": 0.03, "db3": 0.02, "ulg": 0.015, "parquet": 0.02, "tum": 0.02, "gcsv": 0.01}
"""Shares of the formats of other programs, by ending; the library searches a damaged ULog byte by byte."""


def foreign(folder: Path) -> list[Target]:
    """Write one file of each format of other programs that its library can write; return them."""
    n, draw = 30, np.random.default_rng(2)
    whole = recordings.Recording(
        source="flight",
        time=0.01 * np.arange(n),
        rate=0.1 * draw.standard_normal((n, 3)),
        specific_force=np.array([0.0, 0.0, 9.8]) + draw.standard_normal((n, 3)),
        magnetic_field=1e-5 * draw.standard_normal((n, 3)),
        magnetic_unit="T",
        temperature=20.0 + draw.standard_normal(n),
        true_attitude=quaternion.normalize(draw.standard_normal((n, 4))),
        epoch_ns=1_700_000_000_123_456_789,
    )
    files = []
    for ending, share in FOREIGN.items():
        path = folder / f"flight.{ending}"
        damages: tuple[Damage, ...] = damage.BYTES
        read: Callable[[Path], Any] = recordings.read
        if ending == "tum":
            rows = zip(whole.clock_ns.tolist(), whole.true_attitude[:, [1, 2, 3, 0]].tolist(), strict=True)
            text = "".join(f"{t // 10**9}.{t % 10**9:09d} 0 0 0 {' '.join(map(repr, q))}\n" for t, q in rows)
            path.write_text(text)
            damages, read = damage.TEXT, attitudes.read_attitudes
        elif ending == "gcsv":
            if importlib.util.find_spec("telemetry_parser") is None:
                continue
            lines = "".join(f"{k},{k},-{k},1,2,3,4\n" for k in range(n))
            path.write_text(
                f"GYROFLOW IMU LOG\nversion,1.3\nid,x\ntscale,0.001\ngscale,0.001\nascale,0.01\nt,gx,gy,gz,ax,ay,az\n{lines}"
            )
            damages = damage.TEXT
        else:
            library = {"ulg": "pyulog", "parquet": "pyarrow"}.get(ending, "rosbags")
            if importlib.util.find_spec(library) is None:
                continue
            (write_ulog if ending == "ulg" else recordings.write)(whole, path)
            more = {
                "ulg": (damage.replace_word,) * 3,
                "parquet": (damage.change_parquet,) * 2,
            }
            damages += more.get(ending, ())
        files.append(Target(path.name, path.read_bytes(), read, damages, share))
        if ending in ("bag", "mcap", "ulg"):
            topic = "" if ending == "ulg" else "/imu/reference"
            read = functools.partial(attitudes.read_attitudes, topic=topic)
            files.append(Target(path.name, path.read_bytes(), read, damages, 0.3 * share))
    return files


def _write_estimate(path: Path) -> None:
    n, draw = 12, np.random.default_rng(1)
    attitude = quaternion.normalize(draw.standard_normal((n, 4)))
    innovations = records.Innovations(
        time=np.arange(5.0), innovation=draw.standard_normal((5, 2)), variance=np.ones((5, 2))
    )
    estimate = records.Estimate(
        time=np.arange(float(n)),
        attitude=attitude,
        bias=1e-3 * draw.standard_normal((n, 3)),
        variance=np.full((n, 6), 1e-6),
        covariance=np.tile(1e-6 * np.eye(6), (n, 1, 1)),
        innovations={"star": innovations},
        skipped={"star": 1},
        events=(records.Event(kind="gap", start=1.0, end=2.0, value=3.0),),
    )
    low = scenarios.load_scenario("low-orbit")
    truth = records.Truth(attitude=attitude, bias=np.zeros((n, 3)))
    filter_setup = setup.FilterSetup.for_scenario(low)
    setup.write_estimate(path, dataclasses.replace(estimate, truth=truth, setup=filter_setup))


def _write_campaign(path: Path, scenario: scenarios.Scenario) -> None:
    plan = montecarlo.Plan(
        scenario=scenario, setup=setup.FilterSetup.for_scenario(scenario, states=False), epochs=2, nis_bins=2
    )
    runs, arrays = 4, sums.zeros(plan)
    arrays["finite"] += runs
    examples = np.zeros((2, runs, 3, 6))
    statistics = sums.Statistics(
        runs=runs,
        worst_run=np.arange(runs),
        worst_score=np.zeros(runs),
        example_run=np.arange(runs),
        example_error=examples[0],
        example_sigma=examples[1],
        **arrays,
    )
    held = campaign.Campaign(plan=plan, machine="lanes", chunk=4, runs=8, statistics=statistics)
    campaign._write(path, held)


_TRACKER = """[[sensors]]
type = "attitude"
name = "tracker"
rate_hz = 1.0
sigma_across_arcsec = 10.0
sigma_about_arcsec = 40.0
boresight = "z"
latency_s = 0.1
outages_s = [[1.0, 2.0]]

[[sensors]]
type = "magnetometer"
name = "field"
rate_hz = 1.0
sigma_nt = 100.0
orbit = { altitude_km = 500.0, inclination_deg = 97.0 }
"""
_GATE = """
[filter.gate]
probability_ratio = 0.999

[filter.robust]
kind = "huber"
"""
_TABLE = {"title": "Parameters", "columns": ["name", "value"], "rows": [["sigma", "2"]], "notes": ["seen"], "left": 1}
_TUNING = {
    "records": ["a.h5"],
    "units": "SI",
    "report": {
        "verdict": "consistent",
        "reason": "all is well",
        "details": ["none"],
        "words": ["done"],
        "tables": [_TABLE, _TABLE],
    },
}
