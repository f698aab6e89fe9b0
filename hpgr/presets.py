"""Ready scenes. Their values, each with its source, are TOML files in data/presets; a scene file may begin with one."""

from hpgr.scene import DATA, Scene, preset_names

NAMES = preset_names()

__all__ = ["DATA", "NAMES", "industrial", "khd_pilot", "paper"]


def paper() -> Scene:
    """Return the machine and quartz feed of the paper (section 3), rolls 1 m wide.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.paper()
    <hpgr.Scene: rolls 6000 mm x 1000 mm, gap 60 mm, 19 rpm; uniform feed to 60 mm; 10 x 200 x 1000>
    """
    return Scene.preset("paper")


def khd_pilot() -> Scene:
    """Return the KHD pilot rolls with porphyry, test P1 (Torres & Casali 2009), calibrated on pilot tests.

    The gap is the thickness of the cake (docs/validation.md).

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.khd_pilot()
    <hpgr.Scene: rolls 800 mm x 250 mm, gap 23.7 mm, 15.9951 rpm; table feed to 45 mm; 10 x 200 x 1000>
    """
    return Scene.preset("khd_pilot")


def industrial() -> Scene:
    """Return an example of an industrial machine of usual size with the porphyry of the pilot tests.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.industrial().flow.kind
    'nip'
    """
    return Scene.preset("industrial")
