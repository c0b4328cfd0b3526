"""Strapdown gyro attitude estimation.

>>> import strapdown as sd
>>> record = sd.simulate("two-stars", seed=1)  # gyro increments, star vectors, truth
>>> estimate = sd.estimate(record)  # multiplicative EKF, matched to the scenario  # doctest: +SKIP
>>> print(sd.check(estimate, record))  # is the filter consistent?  # doctest: +SKIP

Tasks
    ``simulate``, ``read``, ``read_attitudes``, ``write``, ``estimate``, ``smooth``, ``integrate``, ``check``, ``diagnose``, ``accuracy``,
    ``tune``, ``monte_carlo``, ``covariance_analysis``, ``allan_deviation``, ``fit_noise``, ``calibrate``, ``export``, ``initial_state``
Classes
    ``Scenario``, ``GyroSpec``, ``VectorSensor``, ``FilterSetup``, ``ProcessNoise``, ``Gate``, ``Robust``; ``LiveFilter`` and
    ``StepFilter`` filter sample by sample, compiled and on filterpy, ``LiveAhrs`` as ``estimate`` does a recording. Every function raises
    ``InputError`` on bad input; the message names the value, its place and the remedy. A section *Raises* lists further conditions.
Submodules
    Each has its own ``__all__``; public below them are ``estimation.error_states``, ``estimation.filters``,
    ``estimation.multiple_model``, ``estimation.setup``, ``montecarlo.campaign``, ``montecarlo.cluster``, ``montecarlo.coning_study`` and
    ``tuning.diagnosis``. Names and submodules are loaded on first use.
    All other modules and names (``kernels``, ``cli``, ``checks``, ``files``, ``reading``, ``tables``, …) are private and may change.

Conventions, the same in code, files and plots
----------------------------------------------
Quaternions
    Hamilton product, scalar first ``(w, x, y, z)``, shape ``(..., 4)``. ``q_fb`` takes body vectors to the fixed (reference)
    frame: ``v_f = q_fb ⊗ v_b ⊗ q_fb⁻¹``, *Quaternion differentiation*, equation (5).
Kinematics
    Body rate ``w_b``: ``q̇ = ½ q ⊗ w_b``, equation (17). Fixed-frame rate ``w_f``: ``q̇ = ½ w_f ⊗ q``, equation (3).
Attitude error
    Body side: ``q_true = q_estimate ⊗ exp(δθ)``, ``δθ`` a rotation vector in the body frame, rad.
Error state of the filter
    ``(δθ, δb)`` with ``δb = b_true − b_estimate`` in rad/s; ``P = E[δx δxᵀ]`` in the tangent space after the reset.
Units
    SI and radians. Degrees, °/h, °/√h and arcseconds are used only in files, figures and on the command line, with the unit in the name.
"""

__version__ = "0.1.0"

TYPE_CHECKING = False  # typing has the same constant, and would take longer to load than this module
if TYPE_CHECKING:
    from strapdown import (
        ahrs,
        allan,
        calibration,
        codegen,
        coning,
        consistency,
        covariance,
        estimation,
        gyro,
        kinematics,
        montecarlo,
        motion,
        plots,
        quaternion,
        recordings,
        records,
        report,
        scenarios,
        tuning,
        units,
        vectors,
    )
    from strapdown.ahrs import LiveAhrs
    from strapdown.allan import allan_deviation, fit_noise
    from strapdown.calibration import calibrate
    from strapdown.checks import InputError
    from strapdown.codegen import export
    from strapdown.estimation import Gate, LiveFilter, ProcessNoise, Robust, StepFilter, initial_state
    from strapdown.estimation.setup import FilterSetup
    from strapdown.gyro import GyroSpec
    from strapdown.scenarios import Scenario
    from strapdown.vectors import VectorSensor
    from strapdown.workflows import (
        accuracy,
        check,
        covariance_analysis,
        diagnose,
        estimate,
        integrate,
        monte_carlo,
        read,
        read_attitudes,
        simulate,
        smooth,
        tune,
        write,
    )

__all__ = [
    "FilterSetup",
    "Gate",
    "GyroSpec",
    "InputError",
    "LiveAhrs",
    "LiveFilter",
    "ProcessNoise",
    "Robust",
    "Scenario",
    "StepFilter",
    "VectorSensor",
    "accuracy",
    "ahrs",
    "allan",
    "allan_deviation",
    "calibrate",
    "calibration",
    "check",
    "codegen",
    "coning",
    "consistency",
    "covariance",
    "covariance_analysis",
    "diagnose",
    "estimate",
    "estimation",
    "export",
    "fit_noise",
    "gyro",
    "initial_state",
    "integrate",
    "kinematics",
    "monte_carlo",
    "montecarlo",
    "motion",
    "plots",
    "quaternion",
    "read",
    "read_attitudes",
    "recordings",
    "records",
    "report",
    "scenarios",
    "simulate",
    "smooth",
    "tune",
    "tuning",
    "units",
    "vectors",
    "write",
]

_HOMES = {
    name: home
    for home, names in {
        "ahrs": "LiveAhrs",
        "allan": "allan_deviation fit_noise",
        "calibration": "calibrate",
        "checks": "InputError",
        "codegen": "export",
        "estimation": "Gate LiveFilter ProcessNoise Robust StepFilter initial_state",
        "estimation.setup": "FilterSetup",
        "gyro": "GyroSpec",
        "scenarios": "Scenario",
        "vectors": "VectorSensor",
        "workflows": "accuracy check covariance_analysis diagnose estimate integrate monte_carlo read read_attitudes simulate smooth tune "
        "write",
    }.items()
    for name in names.split()
}
"""Submodule of each name that is not a submodule."""


if not TYPE_CHECKING:  # type checkers use the imports above and must report any other name

    def __getattr__(name: str):
        """Load a name or a submodule on first use (PEP 562)."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        if name not in _HOMES:
            return import_module(f"{__name__}.{name}")
        value = globals()[name] = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
        return value


def __dir__() -> list[str]:
    return list(__all__)
