"""The README's code runs as it stands there."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from strapdown import quaternion

README = Path(__file__).resolve().parents[1] / "README.md"


@pytest.fixture
def blocks():
    """The blocks of Python in the README, in order."""
    return re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


def write_walk(path):
    """Ten seconds of a unit at rest for three and then turned about, 100 Hz: its accelerometer in g, its gyro in °/s."""
    draw = np.random.default_rng(5)
    time = 0.01 * np.arange(1000)
    rate = np.where(time > 3.0, 40.0 * np.sin(2.0 * np.pi * 0.5 * (time - 3.0)), 0.0)
    angle = np.radians(np.cumsum(rate) * 0.01)
    force = np.stack([np.zeros_like(time), np.sin(angle), np.cos(angle)], axis=1)
    gyro = np.stack([rate, np.zeros_like(time), np.zeros_like(time)], axis=1)
    rows = np.column_stack(
        [time, gyro + 0.05 * draw.standard_normal((1000, 3)), force + 2e-3 * draw.standard_normal((1000, 3))]
    )
    np.savetxt(path, rows, delimiter=",", header="time,gx,gy,gz,ax,ay,az", comments="")
    return angle


def test_the_table_of_recordings_is_that_of_the_validation_page():
    """Total and inclination of the same data file, to the digits printed."""
    data = README.parent / "docs" / "_data" / "validation.json"
    broad = json.loads(data.read_text(encoding="utf-8"))["broad"]
    rows = {
        "`estimate`": "strapdown",
        "`estimate --smooth`": "strapdown, smoother",
        "VQF 9D": "VQF",
        "offline VQF": "offline VQF",
    }
    text = README.read_text(encoding="utf-8")
    for words, name in rows.items():
        (row,) = re.findall(rf"^\| {re.escape(words)} \| (.*) / (.*) \| (.*) / (.*) \|$", text, re.MULTILINE)
        found = [broad["errors_deg"][treatment][name] for treatment in ("as recorded", "compensated")]
        assert row == tuple(
            f"{angle:.{digits}f}" for total, _, tilt in found for angle, digits in ((total, 1), (tilt, 2))
        )
    means = [100.0 * broad["coverage"][name]["mean"][2] for name in ("strapdown", "strapdown, smoother")]
    least = 100.0 * min(one["least"][2] for one in broad["coverage"].values())
    words = "hold the inclination in {:.0f} % of the movement (smoothed {:.0f} %), in no trial less than {:.0f} %"
    assert words.format(*means, least) in " ".join(text.split())


def test_the_code_of_the_readme_runs(blocks, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    angle = write_walk(tmp_path / "walk.csv")
    assert len(blocks) == 1
    names = {}
    exec(blocks[0], names)
    assert len(re.findall(r"^consistent", capsys.readouterr().out, re.MULTILINE)) == 2
    estimate, truth = names["estimate"], names["record"].truth
    error = quaternion.log(quaternion.multiply(quaternion.conjugate(estimate.attitude[-1]), truth.attitude[-1]))
    assert np.all(np.abs(error) < 5.0 * estimate.sigma[-1, :3])
    roll = np.radians(names["angles"][:, 2])
    assert np.sqrt(np.mean((roll - angle[-len(roll) :]) ** 2)) < np.radians(1.0)
