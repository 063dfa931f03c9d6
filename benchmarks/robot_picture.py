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

import numpy as np
from PIL import Image

from ctxval import Campaign, Task, TaskSpace, Validation
from study_parameters import cheetah, cheetah_mjcf

STORED = Path(__file__).parent / "results" / "robot.json"
PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "robot.png"
THRESHOLD = 0.4  # m
GRID = 61
SHOWN = (0, 10, 20, 30, 40)  # steps of 0.05 s
LARGEST = 200_000  # bytes; the README is read over slow lines too


def walk() -> Validation:
    """Return the validation of HalfCheetah with the commanded speed and the pitch at the start as the task."""

    def task(p: Any) -> Task:
        x = np.zeros((*p.points.shape[:-1], 18))
        x[..., 2] = p.points[..., 1]
        return Task(x, command=p.points[..., :1], horizon=40, dt=0.05)

    space = TaskSpace(speed=(0.5, 2.5, "m/s"), pitch=(-0.2, 0.2, "rad"))
    return cheetah("inside").with_parts(space=space, task=task)


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


def photograph(runs: dict[str, list[list[float]]]) -> np.ndarray:
    """Return a picture of both robots of the worst task, the model as a pale one, at some times side by side."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    import mujoco

    text = cheetah_mjcf().replace('rgba="0.8 0.9 0.8 1"', 'rgba="1 1 1 1"')
    model = mujoco.MjModel.from_xml_string(text)
    model.vis.headlight.ambient[:] = 0.5
    datas = {name: mujoco.MjData(model) for name in runs}
    views = []
    with mujoco.Renderer(model, 300, 460) as renderer:
        camera, option, perturb = mujoco.MjvCamera(), mujoco.MjvOption(), mujoco.MjvPerturb()
        camera.distance, camera.elevation, camera.azimuth = 2.6, -8, 90
        for step in range(1, len(SHOWN)):
            for name, data in datas.items():
                data.qpos[:] = runs[name][step]
                mujoco.mj_forward(model, data)
            camera.lookat[:] = [np.mean([run[step][0] for run in runs.values()]), 0, 0.55]
            renderer.update_scene(datas["system"], camera, option)
            scene = renderer.scene
            for i in range(scene.ngeom):
                if scene.geoms[i].objid > 0:
                    scene.geoms[i].rgba[:] = [0.0, 0.27, 0.55, 1.0]  # dark blue
            first = scene.ngeom
            mujoco.mjv_addGeoms(model, datas["model"], option, perturb, mujoco.mjtCatBit.mjCAT_DYNAMIC, scene)
            for i in range(first, scene.ngeom):
                scene.geoms[i].rgba[:] = [0.95, 0.60, 0.10, 0.55]  # pale orange
            views.append(renderer.render().copy())
    return np.concatenate([np.concatenate(views[:2], axis=1), np.concatenate(views[2:], axis=1)], axis=0)


def draw(stored: dict[str, Any]) -> None:
    """Write the picture: robots on the left, distances and executed tasks on the right."""
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 15, "font.family": "DejaVu Sans"})
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 5.4), width_ratios=[1.25, 1], layout="constrained")
    left.imshow(photograph(stored["runs"]))
    left.set_axis_off()
    trials, true = np.array(stored["trials"]), np.array(stored["true"])
    worst = trials[np.argmax(trials[:, 2])]
    at = ", ".join(f"{0.05 * step:.1f}" for step in SHOWN[1:])
    left.set_title(f"Worst task, after {at} s:\nrobot (dark) and its model (pale)")
    extent = (0.5, 2.5, -0.2, 0.2)
    image = right.imshow(true.T, origin="lower", extent=extent, aspect="auto", cmap="viridis", vmin=0)
    bar = figure.colorbar(image, ax=right)
    bar.set_label("largest gap of the path [m]")
    right.plot(
        trials[:, 0], trials[:, 1], "o", ms=9, mfc="white", mec="black", mew=1.5, label="executed", clip_on=False
    )
    right.plot(
        *worst[:2], "*", ms=20, mfc="#ff5a36", mec="black", mew=1.2, label=f"worst: {worst[2]:.2f} m", clip_on=False
    )
    right.set_xlabel("commanded speed [m/s]")
    right.set_ylabel("pitch at the start [rad]")
    right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, frameon=False)
    right.set_title(
        f"{stored['answer'].capitalize()} at {stored['threshold']:g} m after {len(trials)} executions\n"
        f"(bound on all tasks: {stored['bound']:.2f} m)",
        fontweight="bold",
    )
    figure.savefig(PICTURE, dpi=100)
    with Image.open(PICTURE) as seen:
        seen.convert("RGB").quantize(160).save(PICTURE, optimize=True)
    if PICTURE.stat().st_size > LARGEST:
        raise SystemExit(f"{PICTURE} has {PICTURE.stat().st_size} bytes, more than {LARGEST}.")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    if not STORED.exists():
        STORED.write_text(json.dumps(run()) + "\n")
    draw(json.loads(STORED.read_text()))
