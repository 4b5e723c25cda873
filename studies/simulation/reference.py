"""What the paper reports and what we set out to reach: the one table of both.

Sources: GND paper, section 6 and Figure 17 (simulation), section 7.4 (PCD baseline); F1 is Eq. (18), in percent.
"""

from typing import Final

STALE: Final = 37.36
SINGLE: Final = 88.05
FLEET: Final = {20: 99.62}
"""By number of vehicles. Figure 17 shows the curve at about 99 from nine vehicles on."""
FLEET_READ_OFF: Final = {9: 99.0}

TARGET_SENSORS: Final = ("vlp16", "hdl32e", "rs16", "rs32")
"""The target of a single drive is the mean over the sensors of 16 and 32 layers."""
MUST: Final = {"single": 88.05, "fleet.9": 96.0, "fleet.20": 97.0, "fleet.20.all": 88.0}
AIM: Final = {"single": 94.0, "fleet.9": 99.0, "fleet.20": 99.62, "fleet.20.all": 95.0}
PCD_UPLOAD_SHARE: Final = 0.04
"""Our upload may be at most this share of the PCD baseline's."""
