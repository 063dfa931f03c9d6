"""Effects that a model may lack: one dictionary for verdicts, causes and repair."""

from ctxval.learning.effects.backlash import Backlash
from ctxval.learning.effects.bias import Bias, InputDrift, InputOffset
from ctxval.learning.effects.dead_zone import DeadZone
from ctxval.learning.effects.effect import Effect, EffectCandidate, Parameter
from ctxval.learning.effects.friction import Coulomb, DirectedFriction, FrictionAtRest, LoadFriction, Stribeck, Viscous
from ctxval.learning.effects.gain import InputGain, ReversedInput, SwappedInputs
from ctxval.learning.effects.inertia import Gravity, Inertia
from ctxval.learning.effects.joint_stop import JointStop
from ctxval.learning.effects.model import ModelWithEffects
from ctxval.learning.effects.mujoco import BodyMass, JointAttribute, MassCentre, SharedAttribute
from ctxval.learning.effects.plant import Joint
from ctxval.learning.effects.run_offset import RunOffset
from ctxval.learning.effects.saturation import RateLimit, Saturation
from ctxval.learning.effects.sensor import SensorOffset, SensorScale, SwappedJoints, WrappedAngle
from ctxval.learning.effects.time_step import TimeStep
from ctxval.learning.effects.transport import Delay, Lag, ObservationDelay

__all__ = [
    "Backlash",
    "Bias",
    "BodyMass",
    "Coulomb",
    "DeadZone",
    "Delay",
    "DirectedFriction",
    "Effect",
    "EffectCandidate",
    "FrictionAtRest",
    "Gravity",
    "Inertia",
    "InputDrift",
    "InputGain",
    "InputOffset",
    "Joint",
    "JointAttribute",
    "JointStop",
    "Lag",
    "LoadFriction",
    "MassCentre",
    "ModelWithEffects",
    "ObservationDelay",
    "Parameter",
    "RateLimit",
    "ReversedInput",
    "RunOffset",
    "Saturation",
    "SensorOffset",
    "SensorScale",
    "SharedAttribute",
    "Stribeck",
    "SwappedInputs",
    "SwappedJoints",
    "TimeStep",
    "Viscous",
    "WrappedAngle",
]
