"""The Earth's field at a place by the World Magnetic Model: true North, and the samples of a magnetometer that differ from the field."""

from __future__ import annotations

import datetime
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from strapdown import quaternion
from strapdown.ahrs.remarks import MAGNETIC_NORTH
from strapdown.checks import Array, InputError, finite, lengths
from strapdown.recordings import Recording
from strapdown.records import Estimate
from strapdown.records.recording import MAGNETIC_UNITS, rows_of, sampled
from strapdown.units import DEGREE

TRUE_NORTH = "East-North-Up, true North"
"""Fixed frame of an estimate that is turned by the declination."""

MAX_STRENGTH_ERROR = 0.2
"""Relative difference of the strength from the model's above which a sample is suspect."""
MAX_DIP_ERROR = 10.0 * DEGREE
"""Difference of the dip from the model's above which it is. In BROAD a heading from a suspect sample is wrong by more than 15° in 74 %,
from another one in 4 %; of phones, whose hard iron is not calibrated, in 49 to 52 % and 16 to 20 %."""


@dataclass(frozen=True, kw_only=True)
class MagneticField:
    """The Earth's field at a place.

    Parameters
    ----------
    declination : float
        Angle from true North to magnetic North, rad, positive to the East.
    dip : float
        Angle of the field below the horizontal, rad.
    strength : float
        Magnitude, T.
    """

    declination: float
    dip: float
    strength: float

    @classmethod
    def at(cls, latitude: float, longitude: float, height: float = 0.0, *, date: datetime.date | str) -> MagneticField:
        """Return the field at a place, by the World Magnetic Model of the package ``pygeomag``.

        Parameters
        ----------
        latitude, longitude : float
            Geodetic (WGS 84), degrees, positive to the North and to the East.
        height : float, default 0.0
            Height above the ellipsoid, m.
        date : datetime.date or str
            Day, such as ``"2026-11-28"``.

        Returns
        -------
        MagneticField
            Its declination, dip and strength.

        Raises
        ------
        InputError
            If a number is out of range, no model covers the date, or the package is not installed.

        References
        ----------
        A. Chulliat et al., The US/UK World Magnetic Model for 2025–2030, NOAA, 2025.

        Examples
        --------
        >>> from strapdown.ahrs import MagneticField
        >>> field = MagneticField.at(52.5, 13.4, date="2026-11-28")  # doctest: +SKIP
        >>> round(field.declination / 0.0174533, 1)  # doctest: +SKIP
        5.2
        """
        for name, value, limit in (("latitude", latitude, 90.0), ("longitude", longitude, 360.0)):
            if not abs(finite(name, value)) <= limit:
                raise InputError(f"{name} is {value:g}; give degrees from {-limit:g} to {limit:g}")
        try:
            day = date if isinstance(date, datetime.date) else datetime.date.fromisoformat(date)
        except (TypeError, ValueError):
            raise InputError(f"date is {date!r}; give a day such as 2026-11-28") from None
        try:
            from pygeomag import GeoMag, decimal_year_from_date
        except ImportError:
            raise InputError("the field at a place needs pygeomag; run pip install 'strapdown[wmm]'") from None
        year = 5 * (day.year // 5)  # a model holds for five years
        model = GeoMag(coefficients_file=f"wmm/WMM_{'2015v2' if year == 2015 else year}.COF")
        try:
            field = model.calculate(
                glat=latitude, glon=longitude, alt=1e-3 * finite("height", height), time=decimal_year_from_date(day)
            )
        except FileNotFoundError:
            raise InputError(f"date is {day}, and pygeomag has no World Magnetic Model of {year}") from None
        return cls(declination=field.d * DEGREE, dip=field.i * DEGREE, strength=1e-9 * field.f)

    def to_true_north(self, estimate: Estimate) -> Estimate:
        """Return an estimate relative to magnetic North as one relative to true North.

        Parameters
        ----------
        estimate : Estimate
            Estimate of a recording with a magnetometer, East-North-Up.

        Returns
        -------
        Estimate
            Attitudes from the body axes to East-North-Up with true North; a reference attitude is unchanged.

        Examples
        --------
        >>> field.to_true_north(sd.estimate(recording)).attitude  # doctest: +SKIP
        """
        if estimate.fixed_frame != MAGNETIC_NORTH:
            raise InputError(
                f"the estimate's fixed frame is {estimate.fixed_frame or 'that of its record'!r}, without magnetic North; give one of "
                "a recording with a magnetometer"
            )
        # Magnetic North is turned from true North by the declination, clockwise as seen from above.
        north = quaternion.exp(np.array([0.0, 0.0, -self.declination]))
        return replace(
            estimate,
            attitude=quaternion.multiply(north, estimate.attitude),
            fixed_frame=TRUE_NORTH,
            remarks=tuple(words.replace(MAGNETIC_NORTH, TRUE_NORTH) for words in estimate.remarks),
        )

    def compared(self, recording: Recording, estimate: Estimate) -> FieldComparison:
        """Return the samples of a magnetometer beside this field; headings from samples that differ much are doubtful.

        Parameters
        ----------
        recording : Recording
            Recording with a magnetometer. If the unit of its samples is not declared, their median strength is set to the model's.
        estimate : Estimate
            Its estimate, of which only the vertical is used.

        Returns
        -------
        FieldComparison
            Strength and dip of each sample, and which samples are suspect.

        Examples
        --------
        >>> field.compared(recording, estimate).suspect.mean()  # doctest: +SKIP
        0.08
        """
        if recording.magnetic_field is None:
            raise InputError(f"{recording.source} has no magnetometer; give a recording that has one")
        samples = recording.magnetic_field[rows_of(recording, estimate.time)]
        known = sampled(samples)
        size = np.where(known, lengths(samples), np.nan)
        unit = MAGNETIC_UNITS.get(recording.magnetic_unit) or self.strength / float(np.nanmedian(size))
        up = quaternion.rotate(estimate.attitude, np.where(known[:, None], samples, 0.0))[:, 2]
        return FieldComparison(
            field=self, time=estimate.time, strength=unit * size, dip=np.arcsin(np.clip(-up / size, -1.0, 1.0))
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class FieldComparison:
    """Samples of a magnetometer beside the Earth's field at the place.

    Parameters
    ----------
    field : MagneticField
        The Earth's field.
    time : ndarray (n,)
        Times, s.
    strength, dip : ndarray (n,)
        Strength, T, and dip, rad, of the samples; NaN without one.
    """

    field: MagneticField
    time: Array
    strength: Array
    dip: Array

    @property
    def suspect(self) -> np.ndarray:
        """Samples (n,) whose strength differs from the field's by more than 20 %, or whose dip does by more than 10°."""
        strength = np.abs(self.strength / self.field.strength - 1.0)
        return np.asarray((strength > MAX_STRENGTH_ERROR) | (np.abs(self.dip - self.field.dip) > MAX_DIP_ERROR))

    @property
    def share(self) -> float:
        """Share of the samples that are suspect."""
        return float(np.mean(self.suspect[np.isfinite(self.strength)]))

    def __str__(self) -> str:
        """Describe the field and the samples in two sentences."""
        field, limits = self.field, f"{MAX_DIP_ERROR / DEGREE:.0f}° or {MAX_STRENGTH_ERROR:.0%}"
        dip, strength = np.nanmedian(self.dip), np.nanmedian(self.strength)
        return (
            f"True North: declination {field.declination / DEGREE:.1f}°. The field has a dip of {field.dip / DEGREE:.0f}° and "
            f"{1e6 * field.strength:.1f} uT; the samples' medians are {dip / DEGREE:.0f}° and {1e6 * strength:.1f} uT, and "
            f"{self.share:.0%} of the samples differ by more than {limits}: headings from these are doubtful."
        )

    def summary(self) -> dict[str, Any]:
        """Return the field, the medians of the samples, and the spans of suspect ones, as plain values for JSON.

        Returns
        -------
        dict
            ``field``, ``median``, ``suspect_share``, and ``suspect_spans``: first and last time of each run of suspect samples, s.
        """
        edges = np.flatnonzero(np.diff(self.suspect.astype(int), prepend=0, append=0)).reshape(-1, 2)
        median = {"dip": float(np.nanmedian(self.dip)), "strength": float(np.nanmedian(self.strength))}
        return {
            "field": asdict(self.field),
            "median": median,
            "suspect_share": self.share,
            "suspect_spans": [[float(self.time[first]), float(self.time[stop - 1])] for first, stop in edges],
        }
