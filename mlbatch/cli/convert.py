"""`mlbatch convert`: the main job."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from mlbatch.cli.words import decode_words, format_words, one_of, point_layout_words

LAYOUTS = ("dense", "organized")
SORTS = ("columns", "points")
PLY_STYLES = ("standard", "cloudcompare", "float")
COMPRESSIONS = ("none", "lz4", "zstd")
CLOCKS = ("sensor", "host")
BATCHINGS = ("window", "latest", "approximate", "collate")
BATCHING_TIMES = ("common", "own")
INSTANTS = ("start", "middle", "end")
ALIGN_TO = ("host", "first")
ON_JUMP = ("error", "split")


def convert(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings of one session: pcap, pcapng, MCAP, ROS bags; folders of them; "
            "patterns in quotes ('*.pcap')."
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="A .mcap or .bag file, or a folder (one file a scan)."),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option("--rig", "-r", help="Rig file (YAML).", metavar="FILE")
    ] = None,
    rate: Annotated[
        str | None,
        typer.Option(help="Scan rate, Hz: 10, 29.97, 10/3.  [default: rig's, or 10]", metavar="HZ"),
    ] = None,
    format_: Annotated[
        str | None,
        one_of(
            format_words,
            *("--format", "-f"),
            help="mcap, npz, ply, pcd, las, laz, kitti, nuscenes, rosbag1, rosbag2.  "
            "[default: by OUTPUT; a folder: npz]",
            metavar="FORMAT",
        ),
    ] = None,
    layout: Annotated[
        str,
        one_of(LAYOUTS, "--layout", help="dense: valid points only; organized: slots x columns."),
    ] = "dense",
    sort: Annotated[
        str,
        one_of(
            SORTS,
            "--sort",
            help="Order of a scan's points: columns (time of their columns) or points.",
        ),
    ] = "columns",
    point_layout: Annotated[
        str,
        one_of(
            point_layout_words,
            "--point-layout",
            help="Fields of a PointCloud2 point (preset). FAST-LIO2: 128 rings at most.",
            metavar="NAME",
        ),
    ] = "standard",
    compression: Annotated[
        str,
        one_of(
            COMPRESSIONS,
            "--compression",
            help="Of MCAP chunks: none, lz4, zstd, or zstd:LEVEL from 1 to 22 (zstd: 1).",
            metavar="NAME",
        ),
    ] = "none",
    stamp: Annotated[
        str,
        one_of(
            INSTANTS,
            "--stamp",
            help="Instant of the window that messages are stamped with; times of points count "
            "from its start.",
        ),
    ] = "start",
    ply_style: Annotated[
        str,
        one_of(
            PLY_STYLES,
            "--ply-style",
            help="PLY properties: standard, cloudcompare, float (small_gicp).",
            metavar="NAME",
        ),
    ] = "standard",
    max_bag_duration: Annotated[
        float,
        typer.Option(
            help="rosbag2: a new file of the bag every so many s of recording.  [default: one "
            "file]",
            metavar="S",
            show_default=False,
        ),
    ] = 0.0,
    batching: Annotated[
        str,
        one_of(
            BATCHINGS,
            "--batching",
            help="window; or frame-level fusion of sweeps, as drivers and message filters give: "
            "latest, approximate, collate.",
            metavar="POLICY",
        ),
    ] = "window",
    batching_times: Annotated[
        str,
        one_of(
            BATCHING_TIMES,
            "--batching-times",
            help="Times of points in fused sweeps: from the start of the set (common), or of "
            "their own sweep, as drivers give them (own).",
        ),
    ] = "common",
    deskew: Annotated[
        str | None,
        typer.Option(
            help="Move points to one instant of their window by poses: imu, a trajectory "
            "(FILE.tum: time x y z qx qy qz qw of the body), or constant-velocity, estimated from "
            "the points.",
            metavar="SOURCE",
        ),
    ] = None,
    deskew_to: Annotated[
        str | None,
        one_of(
            INSTANTS,
            "--deskew-to",
            help="Instant of the window that points are moved to.  [default: start]",
        ),
    ] = None,
    slices: Annotated[
        int, typer.Option(help="Sub-scans a window, published one by one.", metavar="N")
    ] = 1,
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
        typer.Option(help="Idle-source timeout: wait for a silent sensor, s, or inf.", metavar="S"),
    ] = "1.0",
    start: Annotated[
        str | None,
        typer.Option(
            help="First window starts at or after: epoch s, ISO time (UTC), or +S.", metavar="T"
        ),
    ] = None,
    end: Annotated[
        str | None, typer.Option(help="Windows start before: as --start.", metavar="T")
    ] = None,
    clock: Annotated[
        str,
        one_of(CLOCKS, "--clock", help="sensor: timestamps in the packets; host: receive times."),
    ] = "sensor",
    align_clocks: Annotated[
        bool,
        typer.Option("--align-clocks", help="Map all clocks onto one; reads the recording twice."),
    ] = False,
    align_to: Annotated[
        str,
        one_of(
            ALIGN_TO,
            "--align-to",
            help="host: clock of the capture host; first: of the first sensor.",
        ),
    ] = "host",
    on_jump: Annotated[
        str,
        one_of(
            ON_JUMP, "--on-jump", help="At a clock step: error, or split into outputs named .segN."
        ),
    ] = "error",
    min_range: Annotated[float, typer.Option(help="Drop nearer points, m.", metavar="M")] = 0.0,
    max_range: Annotated[
        float, typer.Option(help="Drop farther points, m.", show_default="none", metavar="M")
    ] = float("inf"),
    exclude_box: Annotated[
        list[str] | None,
        typer.Option(
            help="Drop points in x0,y0,z0,x1,y1,z1, m, body frame; repeatable.", metavar="BOX"
        ),
    ] = None,
    keep_repeated: Annotated[
        bool, typer.Option("--keep-repeated", help="Keep the second of two equal returns.")
    ] = False,
    metadata: Annotated[
        list[Path] | None,
        typer.Option(
            *("--metadata", "-m"),
            help="Metadata or calibration; repeatable.  [default: next to RECORDING]",
            metavar="FILE",
        ),
    ] = None,
    identity_extrinsics: Annotated[
        bool, typer.Option("--identity-extrinsics", help="Sensors without extrinsics: at 0, 0, 0.")
    ] = False,
    decode: Annotated[
        list[str] | None,
        one_of(
            decode_words,
            "--decode",
            help="KEY=VALUE for decoders: crc=check, firing_azimuth=off; repeatable.",
            metavar="KEY=VALUE",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            *("--only", "--include-sensor"),
            help="Use this sensor (name or serial); repeatable.",
            metavar="NAME",
        ),
    ] = None,
    ignore: Annotated[
        list[str] | None,
        typer.Option(
            *("--ignore", "--exclude-sensor"),
            help="Leave out this sensor (name, serial number, topic or IP:PORT); repeatable.",
            metavar="NAME",
        ),
    ] = None,
    pass_: Annotated[
        list[str] | None,
        typer.Option(
            *("--pass", "--copy-topic"),
            help="Copy this topic (or pattern) of a bag; repeatable.",
            metavar="TOPIC",
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="Inject a fault, as drop:left:5% or stall:left:5s-8s; repeatable.",
            metavar="FAULT",
        ),
    ] = None,
    fault_seed: Annotated[int, typer.Option(help="Seed of random faults.", metavar="N")] = 0,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Do not write; print the report (with --on-jump split a line a segment).",
        ),
    ] = False,
    report: Annotated[
        Path | None,
        typer.Option(
            help="Path of the report (JSON); -: print it instead of the summary.", metavar="FILE"
        ),
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            help="Also write a page of the run (HTML), see mlbatch report.", metavar="FILE"
        ),
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(
            help="Make every Nth scan only, from the Kth on; mlbatch merge joins all N shards.",
            metavar="K/N",
        ),
    ] = None,
    jobs: Annotated[
        str,
        typer.Option(
            *("--jobs", "-j"),
            help="Scans made at the same time, a thread each; auto: cores, up to 4, if writing is "
            "slow.",
            metavar="N|auto",
        ),
    ] = "auto",
    engine: Annotated[str, typer.Option("--engine", hidden=True)] = "",
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
    # As a path, s3://bucket/name is s3:/bucket/name.
    paths = [str(path).partition(":/") for path in (*recordings, *(metadata or ()), output, rig)]
    if any(colon and scheme.isalnum() for scheme, colon, _ in paths):
        from mlbatch.cli.convert_remote import convert_remote

        return convert_remote(sys.argv[2:])
    from mlbatch.cli import options
    from mlbatch.cli.run import Target, run
    from mlbatch.discovery.discover import SensorSelection
    from mlbatch.pipeline.job import (
        Job,
        check_batching,
        check_deskew,
        check_max_bag_s,
        check_sort,
    )
    from mlbatch.readers.inputs import expand
    from mlbatch.report.limits import parse_limits
    from mlbatch.writers import parse_jobs

    options.choices(
        layout=(layout, LAYOUTS),
        stamp=(stamp, INSTANTS),
        deskew_to=(deskew_to or INSTANTS[0], INSTANTS),
        clock=(clock, CLOCKS),
        align_to=(align_to, ALIGN_TO),
        on_jump=(on_jump, ON_JUMP),
    )
    if engine:
        typer.echo("mlbatch: --engine is ignored, since everything is compiled", err=True)
    options.output(output, dry_run=dry_run)
    options.slices(slices)
    options.ranges_m(min_range, max_range)
    first, last, are_dates = options.time_limits(start, end)
    job = Job(
        recordings=expand(recordings),
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
        stamp=stamp,
        batching=batching,
        batching_times=batching_times,
        deskew=deskew or "",
        deskew_to=deskew_to or INSTANTS[0],
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
        max_bag_s=check_max_bag_s("--max-bag-duration", max_bag_duration),
        shard=options.shard(shard),
    )
    run(
        check_deskew(check_batching(job), deskew_to is not None),
        Target(
            output=output,
            format=format_,
            point_layout=point_layout,
            compression=compression,
            ply_style=ply_style,
            dry_run=dry_run,
            jobs=parse_jobs("--jobs", jobs),
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
