"""Ready scenes, data only; every figure has its source beside it."""

from importlib.resources import files
from pathlib import Path

from hpgr.scene import Scene

DATA = Path(str(files("hpgr") / "data"))  # pilot tests and feed of the porphyry, as CSV


def paper() -> Scene:
    """Return the machine and quartz feed of the paper (section 3), rolls 1 m wide.

    The paper gives no roll width, so throughput is per metre of width. Material values are the defaults
    of `hpgr.Material`, whose fields name their sources.
    """
    return Scene(
        rolls=dict(
            diameter=6.0,  # paper section 3
            width=1.0,  # ours: the paper gives none
            gap=0.06,  # paper section 3, s_b = 60 mm
            entry_gap=1.14,  # paper section 3, s_t = 1140 mm
            speed="19 rpm",  # paper section 3
        ),
        feed=dict(kind="uniform", bottom_size=0.008, top_size=0.06),  # paper section 3, 8 to 60 mm
    )


def khd_pilot() -> Scene:
    """Return the KHD pilot rolls with porphyry, test P1 (Torres & Casali 2009). Uncalibrated."""
    return Scene(
        rolls=dict(
            diameter=0.80,  # Torres & Casali 2009
            width=0.25,  # Torres & Casali 2009
            gap=0.0237,  # test P1, thickness of the cake
            entry_gap=0.051,  # ours: 15 degrees, above the nip
            speed=0.67 / 0.40,  # test P1, peripheral speed 0.67 m/s
        ),
        material=dict(
            solid_density=2740.0,  # Torres & Casali 2009, porphyry
            feed_solid_fraction=0.595,  # bulk density 1.63 t/m3 over 2.74 t/m3
            max_solid_fraction=1.0,
            bulk_modulus=600e6,
            shear_modulus=600e6 * 13.1 / 28.3,
        ),
        flow=dict(profile="nip", cake_solid_fraction=0.84),
        feed=dict(kind="table", table=str(files("hpgr") / "data" / "khd_porphyry_feed.csv")),
        note="uncalibrated",
    )


def industrial() -> Scene:
    """Return an industrial machine, D 2.2 m, L 1.0 m."""
    return Scene(
        rolls=dict(diameter=2.2, width=1.0, gap=0.055, entry_gap=0.14, speed=1.364),
        material=dict(
            solid_density=2740.0,
            feed_solid_fraction=0.595,
            max_solid_fraction=1.0,
            bulk_modulus=600e6,
            shear_modulus=600e6 * 13.1 / 28.3,
        ),
        flow=dict(profile="nip", cake_solid_fraction=0.84),
        feed=dict(kind="table", table=str(files("hpgr") / "data" / "khd_porphyry_feed.csv")),
        note="uncalibrated",
    )


PRESETS = {"paper": paper, "khd_pilot": khd_pilot, "industrial": industrial}
