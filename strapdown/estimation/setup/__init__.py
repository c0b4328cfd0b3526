"""Filter setups: noise model of the gyro and of each sensor, initial uncertainty, integration algorithm, gate and error states.

One object for the command line, the Monte Carlo and the tuning. As a file it is the table ``[filter]`` of a TOML document, with units in
the names of its keys; a setup is read back bit for bit.

- ``filter_setup``: :class:`FilterSetup`, given or matched to a scenario or a record.
- ``states``: :class:`States` and :class:`SensorStates`, the error states of a setup.
- ``matching``: Noise and error states for a specification.
- ``running``: The filter of a setup over a record: :func:`run`, :func:`smooth`.
- ``files``: Setups in TOML files.
- ``for_record``: The initial state for a record.
- ``unmodelled``: What is specified and a filter does not model.
- ``estimate_files``: Estimates in HDF5 files, with their filter.
"""

from strapdown.estimation.setup.estimate_files import read_estimate as read_estimate
from strapdown.estimation.setup.estimate_files import write_estimate as write_estimate
from strapdown.estimation.setup.files import from_table as from_table
from strapdown.estimation.setup.files import from_toml as from_toml
from strapdown.estimation.setup.files import read_setup
from strapdown.estimation.setup.files import to_table as to_table
from strapdown.estimation.setup.files import to_toml as to_toml
from strapdown.estimation.setup.filter_setup import MEKF as MEKF
from strapdown.estimation.setup.filter_setup import FilterSetup
from strapdown.estimation.setup.filter_setup import need_angles as need_angles
from strapdown.estimation.setup.filter_setup import need_mekf as need_mekf
from strapdown.estimation.setup.filter_setup import need_setup as need_setup
from strapdown.estimation.setup.matching import commutes_badly as commutes_badly
from strapdown.estimation.setup.running import at_steps as at_steps
from strapdown.estimation.setup.running import drawn_state as drawn_state
from strapdown.estimation.setup.running import initial_state, run, smooth
from strapdown.estimation.setup.running import measured_motion as measured_motion
from strapdown.estimation.setup.running import modelled_record as modelled_record
from strapdown.estimation.setup.running import observability as observability
from strapdown.estimation.setup.running import prepared as prepared
from strapdown.estimation.setup.running import run_modelled as run_modelled
from strapdown.estimation.setup.running import smooth_modelled as smooth_modelled
from strapdown.estimation.setup.running import with_sigma as with_sigma
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.estimation.setup.unmodelled import remedy as remedy
from strapdown.estimation.setup.unmodelled import specified_errors as specified_errors
from strapdown.estimation.setup.unmodelled import unmodelled as unmodelled
from strapdown.estimation.setup.unmodelled import unmodelled_errors as unmodelled_errors
from strapdown.estimation.setup.unmodelled import unmodelled_words as unmodelled_words

__all__ = [
    "FilterSetup",
    "SensorStates",
    "States",
    "initial_state",
    "read_setup",
    "run",
    "smooth",
]
