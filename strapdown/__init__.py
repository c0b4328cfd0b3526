"""Strapdown gyro attitude estimation.

Conventions, the same in code, files and plots
----------------------------------------------
Quaternions
    Hamilton product, scalar first ``(w, x, y, z)``, shape ``(..., 4)``. ``q_fb`` takes body vectors to the fixed (reference)
    frame: ``v_f = q_fb ⊗ v_b ⊗ q_fb⁻¹``, equation (5) of the source document.
Kinematics
    Body rate ``w_b``: ``q̇ = ½ q ⊗ w_b``, equation (17). Fixed-frame rate ``w_f``: ``q̇ = ½ w_f ⊗ q``, equation (3).
Attitude error
    Body side: ``q_true = q_estimate ⊗ exp(δθ)``, ``δθ`` a rotation vector in the body frame, rad.
Error state of the filter
    ``(δθ, δb)`` with ``δb = b_true − b_estimate`` in rad/s; ``P = E[δx δxᵀ]`` in the tangent space after the reset.
Units
    SI and radians inside. Degrees, °/h, °/√h and arcseconds appear at the rim only, with the unit in the name.

Modules, from the ground up: ``quaternion``, ``kinematics``, ``kernels`` (mathematics); ``motion``, ``coning``, ``gyro``,
``vectors``, ``allan``, ``wahba`` (models); ``records``, ``recordings``, ``outputs``, ``scenarios`` (data); ``mekf``, ``ahrs``,
``smoother``, ``family`` (estimators); ``consistency``, ``montecarlo``, ``coning_study`` (analysis); ``plots``, ``cli`` (faces).
"""

__version__ = "0.1.0"
