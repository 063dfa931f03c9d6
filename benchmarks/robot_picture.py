"""``docs/pictures/robot.png``: a campaign with HalfCheetah, the worst task in MuJoCo and the distances of all tasks.

The campaign is stored in ``results/robot.json`` and runs only if this file is missing (4 minutes). M is HalfCheetah
with five uncertain parameters and a learned policy; S has 20 % less friction, 8 % weaker motors and 15 % more damping.
The map of true distances is computed afterwards from S, which no campaign could do. Needs the extra ``mujoco`` and EGL.
"""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is loaded

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from PIL import Image

from ctxval import Campaign, Task, TaskSpace, Validation
from simulated_robots import ROBOTS, RUNNERS

STORED = Path(__file__).parent / "results" / "robot.json"
PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "robot.png"
THRESHOLD = 0.4  # m
GRID = 61
SHOWN = (10, 40)  # steps of 0.05 s
LARGEST = 200_000  # bytes; the README is read over slow lines too


def walk() -> Validation:
    """Return the validation of HalfCheetah with the commanded speed and the pitch at the start as the task."""

    def task(p: Any) -> Task:
        x = np.zeros((*p.points.shape[:-1], 18))
        x[..., 2] = p.points[..., 1]
        return Task(x, command=p.points[..., :1], horizon=40, dt=0.05)

    space = TaskSpace(speed=(0.5, 2.5, "m/s"), pitch=(-0.2, 0.2, "rad"))
    return ROBOTS["cheetah"].make(ROBOTS["cheetah"].inside).with_parts(space=space, task=task)


def run() -> dict[str, Any]:
    """Run the campaign; return its trials, its verdict, the worst executions and the true distances."""
    validation = walk()
    campaign = Campaign(validation, seed=0)
    campaign.run(40, threshold=THRESHOLD)
    verdict, worst = campaign.verdict(THRESHOLD), campaign.worst
    assert worst is not None
    assert verdict.certificate is not None
    plan = validation.plan([*worst.parameters.values()])
    runs = {"model": plan.model_trajectory, "system": validation.execute(plan)}
    axes = [np.linspace(low, high, GRID) for low, high in zip(validation.space.low, validation.space.high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return {
        "threshold": THRESHOLD,
        "answer": verdict.answer,
        "bound": verdict.certificate.upper_bound,
        "trials": [[*trial.parameters.values(), trial.distance] for trial in campaign.trials],
        "runs": {name: np.round(each.states[list(SHOWN), :9], 5).tolist() for name, each in runs.items()},
        "true": np.round(validation.distances(points.reshape(-1, 2)).reshape(GRID, GRID), 4).tolist(),
    }


def photograph(runs: dict[str, list[list[float]]], step: int) -> np.ndarray:
    """Return a picture of the robot at a time of the worst task, with its model as a pale robot."""
    text = RUNNERS["cheetah"].mjcf
    for old, new in (('reflectance="0.5"', 'reflectance="0"'), ('rgb1="0 0 0"', 'rgb1=".8 .8 .8"')):
        text = text.replace(old, new)
    model = mujoco.MjModel.from_xml_string(text.replace('rgb2="0.8 0.8 0.8"', 'rgb2=".95 .95 .95"'))
    model.vis.headlight.ambient[:] = 0.5
    datas = {name: mujoco.MjData(model) for name in runs}
    with mujoco.Renderer(model, 300, 480) as renderer:
        camera, option, perturb = mujoco.MjvCamera(), mujoco.MjvOption(), mujoco.MjvPerturb()
        camera.distance, camera.elevation, camera.azimuth = 1.8, -6, 90
        for name, data in datas.items():
            data.qpos[:] = runs[name][step]
            mujoco.mj_forward(model, data)
        camera.lookat[:] = [np.mean([run[step][0] for run in runs.values()]), 0, 0.5]
        renderer.update_scene(datas["system"], camera, option)
        scene = renderer.scene
        mujoco.mjv_addGeoms(model, datas["model"], option, perturb, mujoco.mjtCatBit.mjCAT_DYNAMIC, scene)
        robots = [geom for geom in scene.geoms[: scene.ngeom] if geom.category == mujoco.mjtCatBit.mjCAT_DYNAMIC]
        for number, geom in enumerate(robots):
            of_model = number >= len(robots) // 2
            geom.rgba[:] = [1.0, 0.65, 0.15, 0.6] if of_model else [0.0, 0.2, 0.5, 1.0]
        return renderer.render().copy()


def draw(stored: dict[str, Any]) -> None:
    """Write the picture: robots on the left, distances and executed tasks on the right."""
    plt.rcParams.update({"font.size": 19, "font.family": "DejaVu Sans"})
    figure = plt.figure(figsize=(10.6, 6.4), layout="constrained")
    axes = figure.subplot_mosaic([["first", "map"], ["last", "map"]], width_ratios=[1, 1.25])
    for step, name in enumerate(("first", "last")):
        axes[name].imshow(photograph(stored["runs"], step))
        axes[name].set_axis_off()
        axes[name].set_title(f"worst task, {0.05 * SHOWN[step]:g} s")
    axes["last"].text(
        0.5, -0.06, "dark: robot\npale: its model", transform=axes["last"].transAxes, ha="center", va="top"
    )
    trials, true, right = np.array(stored["trials"]), np.array(stored["true"]), axes["map"]
    worst = trials[np.argmax(trials[:, 2])]
    image = right.imshow(true.T, origin="lower", extent=(0.5, 2.5, -0.2, 0.2), aspect="auto", cmap="viridis", vmin=0)
    figure.colorbar(image, ax=right, ticks=[0, 0.1, 0.2, 0.3], label="largest gap of their paths [m]")
    right.plot(trials[:, 0], trials[:, 1], "o", ms=11, mfc="white", mec="black", mew=2, label="executed", clip_on=False)
    red = {"mfc": "#ff5a36", "mec": "white", "mew": 1.5, "clip_on": False, "ls": "", "zorder": 5}
    right.plot(*worst[:2], "*", ms=26, label=f"worst: {worst[2]:.2f} m", **red)
    right.set(
        xlabel="speed command [m/s]", ylabel="pitch at start [rad]", xticks=[0.5, 1.5, 2.5], yticks=[-0.2, 0, 0.2]
    )
    right.legend(loc="upper center", bbox_to_anchor=(0.55, -0.16), ncols=2, frameon=False, handletextpad=0.1)
    count, answer = len(trials), stored["answer"]
    right.set_title(f"{answer} at {stored['threshold']:g} m\nafter {count} executions", fontweight="bold")
    figure.savefig(PICTURE, dpi=100)
    with Image.open(PICTURE) as seen:
        seen.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(PICTURE, optimize=True)
    if PICTURE.stat().st_size > LARGEST:
        raise SystemExit(f"{PICTURE} has {PICTURE.stat().st_size} bytes, more than {LARGEST}.")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    if not STORED.exists():
        STORED.write_text(json.dumps(run()) + "\n")
    draw(json.loads(STORED.read_text()))
