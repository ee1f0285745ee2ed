"""`mlbatch simulate`: raw packets of a moving rig in a scene, with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def simulate(
    scenario: Annotated[
        str,
        typer.Argument(
            help="Scenario file (YAML), or room, street, forest-easy, forest-hard, "
            "harvester-easy, harvester-hard."
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Recording to write: .pcap, .mcap or .db3.")
    ],
    duration: Annotated[
        float | None, typer.Option(min=0.1, help="Seconds. [default: the scenario's]")
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, max=2**32 - 1, help="Seed of all noise. [default: the scenario's]"),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing.")] = False,
) -> None:
    """Simulate raw packets of a moving rig in a scene, with rig file and ground truth."""
    from mlbatch.cli.tables import table_lines
    from mlbatch.simulate.recording import write_recording
    from mlbatch.simulate.scenario import read_scenario

    plan = read_scenario(scenario, seed=seed, duration_s=duration)
    figures = write_recording(plan, output, overwrite=overwrite)
    if quiet:
        return
    typer.echo(f"{plan.name}: {plan.duration_s:g} s, seed {plan.seed}")
    rows: list[tuple[str, ...]] = [("lidar", "model", "shots", "returns", "packets", "lost")]
    for lidar, own in zip(plan.lidars, figures.lidars, strict=True):
        counts = (own.shots, own.returns, own.packets, own.lost)
        rows.append((own.name, lidar.settings.model, *map(str, counts)))
    for line in table_lines(rows):
        typer.echo(line)
    typer.echo(f"{figures.poses} poses, {figures.imu_samples} samples of the body's IMU")
    typer.echo(f"wrote {', '.join(path.name for path in figures.files)}")
