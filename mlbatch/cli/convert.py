"""`mlbatch convert`: the main job."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def convert(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings of one session: pcap, pcapng, MCAP, ROS bags.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="A .mcap or .bag file, or a folder (one file a scan)."),
    ] = None,
    rig: Annotated[Path | None, typer.Option(help="Rig file (YAML).")] = None,
    rate: Annotated[
        str | None,
        typer.Option(help="Scan rate, Hz: 10, 29.97, 10/3. [default: rig's, or 10]"),
    ] = None,
    format_: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="mcap, npz, ply, pcd, las, laz, kitti, nuscenes, rosbag1, rosbag2. "
            "[default: by OUTPUT; a folder: npz]",
        ),
    ] = None,
    layout: Annotated[
        str, typer.Option(help="dense: valid points only; organized: slots x columns.")
    ] = "dense",
    sort: Annotated[
        str,
        typer.Option(help="Order of a scan's points: columns (time of their columns) or points."),
    ] = "columns",
    point_layout: Annotated[
        str,
        typer.Option(help="Fields of a PointCloud2 point (preset). FAST-LIO2: 128 rings at most."),
    ] = "standard",
    compression: Annotated[
        str,
        typer.Option(help="Of MCAP chunks: none, lz4, zstd, or zstd:LEVEL from 1 to 22 (zstd: 1)."),
    ] = "none",
    ply_style: Annotated[
        str,
        typer.Option(help="PLY properties: standard, cloudcompare, float (small_gicp)."),
    ] = "standard",
    slices: Annotated[int, typer.Option(help="Sub-scans a window, published one by one.")] = 1,
    split: Annotated[
        bool, typer.Option("--split", help="One scan a sensor instead of merged ones.")
    ] = False,
    keep_partial: Annotated[
        bool, typer.Option("--keep-partial", help="Also write the first and last, partial window.")
    ] = False,
    drop_incomplete: Annotated[
        float,
        typer.Option(
            help="Leave out scans with fewer than P % of any sensor's columns.", metavar="P"
        ),
    ] = 0.0,
    max_wait: Annotated[
        str,
        typer.Option(help="Idle-source timeout: wait for a silent sensor, s, or inf."),
    ] = "1.0",
    start: Annotated[
        str | None,
        typer.Option(help="First window starts at or after: epoch s, ISO time (UTC), or +S."),
    ] = None,
    end: Annotated[str | None, typer.Option(help="Windows start before: as --start.")] = None,
    clock: Annotated[
        str, typer.Option(help="sensor: timestamps in the packets; host: receive times.")
    ] = "sensor",
    align_clocks: Annotated[
        bool,
        typer.Option("--align-clocks", help="Map all clocks onto one; reads the recording twice."),
    ] = False,
    align_to: Annotated[
        str, typer.Option(help="host: clock of the capture host; first: of the first sensor.")
    ] = "host",
    on_jump: Annotated[
        str,
        typer.Option(help="At a clock step: error, or split into outputs named .segN."),
    ] = "error",
    min_range: Annotated[float, typer.Option(help="Drop nearer points, m.")] = 0.0,
    max_range: Annotated[
        float, typer.Option(help="Drop farther points, m.", show_default="none")
    ] = float("inf"),
    exclude_box: Annotated[
        list[str] | None,
        typer.Option(help="Drop points in x0,y0,z0,x1,y1,z1, m, body frame; repeatable."),
    ] = None,
    keep_repeated: Annotated[
        bool, typer.Option("--keep-repeated", help="Keep the second of two equal returns.")
    ] = False,
    metadata: Annotated[
        list[Path] | None,
        typer.Option(help="Metadata or calibration; repeatable. [default: next to RECORDING]"),
    ] = None,
    identity_extrinsics: Annotated[
        bool, typer.Option("--identity-extrinsics", help="Sensors without extrinsics: at 0, 0, 0.")
    ] = False,
    decode: Annotated[
        list[str] | None,
        typer.Option(help="KEY=VALUE for decoders: crc=check, firing_azimuth=off; repeatable."),
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Use this sensor (name or serial); repeatable.")
    ] = None,
    ignore: Annotated[
        list[str] | None,
        typer.Option(
            help="Leave out this sensor (name, serial number, topic or IP:PORT); repeatable."
        ),
    ] = None,
    pass_: Annotated[
        list[str] | None,
        typer.Option("--pass", help="Copy this topic (or pattern) of a bag; repeatable."),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(help="Inject a fault, as drop:left:5% or stall:left:5s-8s; repeatable."),
    ] = None,
    fault_seed: Annotated[int, typer.Option(help="Seed of random faults.")] = 0,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Do not write; print the report (with --on-jump split a line a segment).",
        ),
    ] = False,
    report: Annotated[
        Path | None,
        typer.Option(help="Path of the report (JSON); -: print it instead of the summary."),
    ] = None,
    html: Annotated[
        Path | None, typer.Option(help="Also write a page of the run (HTML), see mlbatch report.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Scans made at the same time, a thread each.")] = 1,
    engine: Annotated[
        str,
        typer.Option(help="Decoder: auto, numpy, or native (compiled)."),
    ] = "auto",
    strict: Annotated[
        bool, typer.Option("--strict", help="The first rejected packet or warning is an error.")
    ] = False,
    fail_on: Annotated[
        list[str] | None,
        typer.Option(
            help="Exit with 3 beyond limits, as loss>0.1%,underfilled>0; repeatable.",
            metavar="LIMITS",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing output.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted run to the same OUTPUT.")
    ] = False,
    no_fsync: Annotated[
        bool, typer.Option("--no-fsync", help="Do not wait until the output is on the disk.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No summary, no progress.")] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Also print what was found and chosen.")
    ] = False,
) -> None:
    """Turn raw lidar packets into merged scans at an exact rate."""
    from mlbatch.cli import options
    from mlbatch.cli.run import Target, run
    from mlbatch.discovery.discover import SensorSelection
    from mlbatch.pipeline.job import Job, check_sort
    from mlbatch.report.limits import parse_limits

    options.choices(
        layout=(layout, ("dense", "organized")),
        clock=(clock, ("sensor", "host")),
        align_to=(align_to, ("host", "first")),
        on_jump=(on_jump, ("error", "split")),
    )
    engine = options.engine(engine)
    options.output(output, dry_run=dry_run)
    options.slices(slices)
    options.ranges_m(min_range, max_range)
    first, last, are_dates = options.time_limits(start, end)
    job = Job(
        recordings=tuple(recordings),
        selection=SensorSelection(
            rig=rig,
            metadata=tuple(metadata or ()),
            only=tuple(only or ()),
            ignore=tuple(ignore or ()),
            identity_extrinsics=identity_extrinsics,
            host_clock=clock == "host",
            aligned=align_clocks,
            decode=options.decode_options(decode or ()),
        ),
        rate=None if rate is None else options.rate(rate),
        slices=slices,
        layout=layout,
        sort=check_sort("--sort", sort, layout),
        split=split,
        keep_partial=keep_partial,
        keep_repeated=keep_repeated,
        drop_incomplete=options.percent("--drop-incomplete", drop_incomplete),
        max_wait_ns=options.max_wait_ns(max_wait),
        start=first,
        end=last,
        limits_are_dates=are_dates,
        min_range_m=min_range,
        max_range_m=max_range,
        boxes_m=tuple(options.box_m(text) for text in exclude_box or ()),
        strict=strict,
        faults=options.faults(fault or ()),
        fault_seed=options.seed(fault_seed),
        align_clocks_to=align_to if align_clocks else "",
        passed=tuple(pass_ or ()),
        jobs=options.jobs(jobs),
        engine=engine,
    )
    run(
        job,
        Target(
            output=output,
            format=format_,
            point_layout=point_layout,
            compression=compression,
            ply_style=ply_style,
            dry_run=dry_run,
            report=None if options.is_stdout(report) else report,
            prints_report=options.is_stdout(report),
            html=html,
            split_jumps=on_jump == "split",
            limits=parse_limits(fail_on or ()),
            overwrite=overwrite,
            resume=options.resume(resume, dry_run=dry_run),
            fsync=not no_fsync,
            quiet=quiet,
            verbose=verbose,
        ),
    )
