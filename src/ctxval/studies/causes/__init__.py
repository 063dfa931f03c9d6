"""Why a model fails: the causes of its error, with their sizes in physical units."""

from ctxval.studies.causes.actuators import (
    Backlash,
    DeadZone,
    Delay,
    InputGain,
    InputOffset,
    Lag,
    ReversedInput,
    Saturation,
    SwappedInputs,
)
from ctxval.studies.causes.cause import Cause, Repaired
from ctxval.studies.causes.find import find_causes
from ctxval.studies.causes.mechanics import Bias, Coulomb, Gravity, Inertia, LoadFriction, Stribeck, TimeStep, Viscous
from ctxval.studies.causes.mjcf import BodyMass, JointAttribute, MassCentre
from ctxval.studies.causes.plant import Joint, Plant
from ctxval.studies.causes.report import CauseReport, Explained, Separating
from ctxval.studies.causes.sensors import SensorOffset, SensorScale, SwappedJoints

__all__ = [
    "Backlash",
    "Bias",
    "BodyMass",
    "Cause",
    "CauseReport",
    "Coulomb",
    "DeadZone",
    "Delay",
    "Explained",
    "Gravity",
    "Inertia",
    "InputGain",
    "InputOffset",
    "Joint",
    "JointAttribute",
    "Lag",
    "LoadFriction",
    "MassCentre",
    "Plant",
    "Repaired",
    "ReversedInput",
    "Saturation",
    "SensorOffset",
    "SensorScale",
    "Separating",
    "Stribeck",
    "SwappedInputs",
    "SwappedJoints",
    "TimeStep",
    "Viscous",
    "find_causes",
]
