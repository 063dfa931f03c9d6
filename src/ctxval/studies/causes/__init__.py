"""Why a model fails: the causes of its error, with their sizes in physical units."""

from ctxval.studies.causes.cause import Cause, Joint, Repaired
from ctxval.studies.causes.find import find_causes
from ctxval.studies.causes.mechanics import (
    Bias,
    BodyMass,
    Coulomb,
    Gravity,
    Inertia,
    JointAttribute,
    LoadFriction,
    MassCentre,
    Stribeck,
    TimeStep,
    Viscous,
)
from ctxval.studies.causes.report import CauseReport
from ctxval.studies.causes.signals import (
    Backlash,
    DeadZone,
    Delay,
    InputGain,
    InputOffset,
    Lag,
    ReversedInput,
    Saturation,
    SensorOffset,
    SensorScale,
    SwappedInputs,
    SwappedJoints,
)

__all__ = [
    "Backlash",
    "Bias",
    "BodyMass",
    "Cause",
    "CauseReport",
    "Coulomb",
    "DeadZone",
    "Delay",
    "Gravity",
    "Inertia",
    "InputGain",
    "InputOffset",
    "Joint",
    "JointAttribute",
    "Lag",
    "LoadFriction",
    "MassCentre",
    "Repaired",
    "ReversedInput",
    "Saturation",
    "SensorOffset",
    "SensorScale",
    "Stribeck",
    "SwappedInputs",
    "SwappedJoints",
    "TimeStep",
    "Viscous",
    "find_causes",
]
