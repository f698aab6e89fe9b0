"""The keys of all randomness: seeds and replicate numbers."""

import operator


def refuse_key(name: str, value: int) -> None:
    """Raise ValueError if a seed or replicate number is not a whole number that a result file can hold."""
    try:
        whole = -1 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        whole = -1
    if not 0 <= whole < 2**63:
        raise ValueError(f"{name}: got {value!r}; must be a whole number from 0 to 2**63 - 1; such as {name}=0")
