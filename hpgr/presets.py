"""Ready scenes, data only; every figure has its source beside it."""

from importlib.resources import files
from pathlib import Path

from hpgr.scene import Scene

DATA = Path(str(files("hpgr") / "data"))  # pilot tests and feed of the porphyry, as CSV


def paper() -> Scene:
    """Return the machine and quartz feed of the paper (section 3), rolls 1 m wide.

    The paper gives no roll width, so throughput is per metre of width. Material values are the defaults
    of `hpgr.Material`, whose fields name their sources.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.paper()
    <hpgr.Scene: rolls 6000 mm x 1000 mm, gap 60 mm, 19 rpm; uniform feed to 60 mm; 10 x 200 x 1000>
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


# The porphyry of Torres & Casali (2009) as `python -m studies.pilot` fits it to tests P1 and P3 (docs/validation.md).
# Strength and moduli are the fitted ones times 1 - kappa/3: the mean over the roll width, which presets do not resolve.
_FITTED_MEAN = 1 - 0.896 / 3  # fitted kappa
_PORPHYRY = dict(
    solid_density=2740.0,  # Torres & Casali 2009
    feed_solid_fraction=0.595,  # bulk density 1.63 t/m3 over 2.74 t/m3
    max_solid_fraction=1.0,  # ours: mass continuity holds up to solid rock
    strength=2.24e6 * _FITTED_MEAN,  # fitted, at strength_size
    strength_size=0.06,  # paper section 3
    weibull_modulus=1.71,  # fitted
    cushioning=0.586,  # fitted
    fragment_exponent=0.372,  # fitted
    bulk_modulus=963e6 * _FITTED_MEAN,  # fitted
    shear_modulus=963e6 * _FITTED_MEAN * 13.1 / 28.3,  # the paper's ratio of G to K
)


def khd_pilot() -> Scene:
    """Return the KHD pilot rolls with porphyry, test P1 (Torres & Casali 2009), calibrated on tests P1 and P3.

    The gap is the thickness of the cake: with the measured working gap, 19.0 mm, continuity would need a cake denser
    than rock (docs/validation.md).

    Source: Torres & Casali, "A novel approach for the modelling of high-pressure grinding rolls",
    Minerals Engineering 22 (2009) 1137-1146, and the theses behind it.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.khd_pilot()
    <hpgr.Scene: rolls 800 mm x 250 mm, gap 23.7 mm, 15.9951 rpm; table feed to 45 mm; 10 x 200 x 1000>
    """
    return Scene(
        rolls=dict(
            diameter=0.80,  # Torres & Casali 2009
            width=0.25,  # Torres & Casali 2009
            gap=0.0237,  # test P1, thickness of the cake
            entry_gap=0.060,  # ours: an angle of 17 degrees, above the nip
            speed=0.67 / 0.40,  # test P1, peripheral speed 0.67 m/s
            idle_torque=5.33e3,  # fitted
        ),
        material=_PORPHYRY,
        flow=dict(profile="nip", nip_angle="9.09 deg"),  # fitted
        feed=dict(kind="table", table=str(DATA / "khd_porphyry_feed.csv")),
        note="ore and machine as fitted to pilot tests P1 and P3 (docs/validation.md); the roll width is not resolved",
    )


def industrial() -> Scene:
    """Return an example of an industrial machine of usual size with the porphyry of the pilot tests.

    No plant of its own stands behind it. Sizes and speed lie within usual ranges (model page, Real machines); ore and
    nip as in Torres & Casali 2009 and `khd_pilot`.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.industrial().flow.profile
    'nip'
    """
    return Scene(
        rolls=dict(
            diameter=2.2,  # usual: 0.5 to 2.8 m
            width=1.0,  # usual: about half the diameter
            gap=0.055,  # usual: 0.02 to 0.03 diameters
            entry_gap=0.150,  # ours: an angle of 17 degrees, above the nip
            speed="13 rpm",  # usual: a peripheral speed of about 1.5 m/s
        ),
        material=_PORPHYRY,
        flow=dict(profile="nip", nip_angle="9.09 deg"),  # that of the ore, fitted
        feed=dict(kind="table", table=str(DATA / "khd_porphyry_feed.csv")),
        note="an example, not a plant: usual sizes, with the ore fitted to pilot tests",
    )


PRESETS = {"paper": paper, "khd_pilot": khd_pilot, "industrial": industrial}
