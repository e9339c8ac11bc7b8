"""Parameters that the vehicle sets by itself. Layer: parameters; pure.

These are counters, values that the vehicle measures at each start, the numbers of items in its missions, and
the format of its memory. No user wants to restore them, and most clients leave them out when they load a
file.
Source: docs/servers.md 17.
"""

from __future__ import annotations

import re

_OWN = re.compile(
    r"STAT_\w+|LND_FLIGHT_T_\w+|COM_FLIGHT_UUID|LOG_LASTFILE|SYS_NUM_RESETS"  # counters
    r"|\w*GND_PRESS|GND_ABS_PRESS\d?|GND_TEMP|CAL_BARO\d_OFF|ARSPD\d?_OFFSET"  # measured at the start
    r"|(?:MIS|CMD|FENCE|RALLY)_TOTAL|CMD_INDEX"  # items of missions
    r"|FORMAT_VERSION|SYSID_SW_MREV|SYSID_SW_TYPE"  # another value makes it erase all parameters
)


def is_own(name: str) -> bool:
    """Return whether the vehicle sets this parameter by itself."""
    return _OWN.fullmatch(name) is not None
