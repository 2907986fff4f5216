"""One root for every error this project raises on purpose, one subclass per cause a caller can act on.

A message names the value, the limit and what would have worked. Scripts turn any `AthleteError` into one line and
exit status 2. "No step found" is an answer, not an error, and is not here.
"""


class AthleteError(Exception):
    """Root of all errors raised on purpose."""


class ConfigError(AthleteError):
    """A name, file, key or value given by the user is not usable."""


class AssetError(AthleteError):
    """A file that the project ships is missing or damaged."""


class MissingLibraryError(AthleteError):
    """A shared library of the system that a dependency needs is not installed."""


class TerrainError(AthleteError):
    """A height map or a terrain query is not usable."""


class KinematicsError(AthleteError):
    """A configuration or a target has the wrong shape, is not finite or lies outside the limits."""


class CameraError(AthleteError):
    """A camera name, an image or a calibration is not usable."""


class MessageError(AthleteError):
    """A message that crossed the link is damaged or not of a known kind."""


class LinkError(AthleteError):
    """A link parameter or a send time is not usable."""


class CommandError(AthleteError):
    """A command is malformed: the executive would refuse it."""


class PhysicsError(AthleteError):
    """The simulation left the range in which its numbers mean something."""


class SupportError(AthleteError):
    """A set of wheels spans no support polygon."""


class SagError(AthleteError):
    """A sag problem is posed with the wrong shapes or constants."""


class PlanningError(AthleteError):
    """A planning problem is posed wrongly: a start in collision, limits crossed."""


class RecordingError(AthleteError):
    """A recording cannot be written or read."""
