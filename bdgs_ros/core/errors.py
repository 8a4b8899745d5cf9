"""The errors a caller can expect, one tree under `BdgsError`."""


class BdgsError(Exception):
    """Base of every error that this package raises on purpose."""


class ConfigError(BdgsError):
    """A parameter is unknown, of the wrong type or out of its range."""


class DatasetError(BdgsError):
    """A recording is missing, truncated, or not laid out as expected."""


class ModelError(BdgsError):
    """Network weights cannot be read or do not have the expected inputs and outputs."""


class MapError(BdgsError):
    """A Gaussian map cannot be loaded, saved or used."""


class JournalError(BdgsError):
    """What a run left while it went on cannot be read or gone on with."""


class EvaluationError(BdgsError):
    """Two trajectories or images cannot be compared."""
