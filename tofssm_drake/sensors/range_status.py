"""What a sensor says of its own sample: the range status.

The numbers are those of ST's API, which ring devices send as well. A model of
any other sensor reports the one that fits:

| what the sensor says       | status                | what becomes of it     |
|----------------------------|-----------------------|------------------------|
| a distance                 | STATUS_VALID          | an obstacle, or masked |
| nothing came back          | STATUS_SIGNAL_FAIL    | clear, once confirmed  |
| nearer than can be measured| STATUS_MIN_RANGE_FAIL | an obstacle at 0 m     |
| something, but no distance | STATUS_SIGMA_FAIL     | a fault                |
| broken                     | STATUS_HARDWARE_FAIL  | a fault                |

`tofssm_drake.perception.readings` has the whole table. A number that is not in
it is a fault.
"""

import numpy as np

from tofssm_drake.kernels import njit

STATUS_VALID = 0
STATUS_SIGMA_FAIL = 1
STATUS_SIGNAL_FAIL = 2
STATUS_MIN_RANGE_CLIPPED = 3
STATUS_OUT_OF_BOUNDS = 4
STATUS_HARDWARE_FAIL = 5
STATUS_WRAP_AROUND = 7
STATUS_PROCESSING_FAIL = 8
STATUS_MIN_RANGE_FAIL = 13
# The following numbers are this project's own: first those of the host, then
# those of a device.
STATUS_FROZEN = 240
STATUS_SELF_TEST = 241
STATUS_CONTESTED = 242
STATUS_BUS_FAILURE = 253
STATUS_NO_NEW_DATA = 254
STATUS_NONE = 255

SATURATED = 65.535
"""The largest distance that 16 bits of millimetres hold, m."""


@njit(cache=True)
def is_no_return(status):
    """Returns whether a status says that nothing came back."""
    return (
        status == STATUS_SIGNAL_FAIL
        or status == STATUS_OUT_OF_BOUNDS
        or status == STATUS_WRAP_AROUND
    )


def convert_status(status: np.ndarray) -> np.ndarray:
    """Returns statuses as they are sent, (n,), uint8.

    What is not a whole number from 0 to 255 is STATUS_NONE, a fault: it must
    not become another status by rounding or wrapping.
    """
    status = np.asarray(status)
    if status.dtype == np.uint8:
        return status.copy()
    is_status = (status >= 0) & (status <= 255) & (status == np.floor(status))
    return np.where(is_status, status, STATUS_NONE).astype(np.uint8)
