"""A hinge with a link and a motor, as text of MJCF."""

from __future__ import annotations


def mjcf(joint: str = "", mass: float = 0.5, gear: float = 1.0) -> str:
    return f"""<mujoco><option timestep="0.005"/><worldbody><body name="link">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.05" {joint}/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="{mass}"/>
    </body></worldbody><actuator><motor name="motor" joint="hinge" gear="{gear}"/></actuator></mujoco>"""
