"""The options of a conversion, one entry each.

Made of them: `mlbatch convert` and its help, the options that `mlbatch batch` passes on, `convert:`
of a rig with its JSON schema, and the page of options. Python has the same names
(`python/options.py`, typed), and the defaults and bounds of this table.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

LAYOUTS: Final = ("dense", "organized")
SORTS: Final = ("columns", "points")
PLY_STYLES: Final = ("standard", "cloudcompare", "float")
COMPRESSIONS: Final = ("none", "lz4", "zstd")
CLOCKS: Final = ("sensor", "host")
BATCHINGS: Final = ("window", "latest", "approximate", "collate")
BATCHING_TIMES: Final = ("common", "own")
INSTANTS: Final = ("start", "middle", "end")
ALIGN_TO: Final = ("host", "first")
ON_JUMP: Final = ("error", "split")

# Kinds of values. What has a list of words is a text as well.
FLAG: Final = "flag"
TEXT: Final = "text"
TEXTS: Final = "texts"  # repeatable
WHOLE: Final = "whole"
NUMBER: Final = "number"
PATH: Final = "path"
PATHS: Final = "paths"  # repeatable

# Groups of the help, in its order.
GROUPS: Final = ("Input", "Batching", "Selection", "Output", "Clocks", "Run")


@dataclass(frozen=True, slots=True)
class Option:
    """An option of a conversion.

    name: as in a rig, with _ for -; about: one line of help; flags: further spellings on the
    command line; words: known values, `is_open` if there are others; low, high: bounds of a number,
    low 0 and high none unless given; in_rig: whether a rig may keep it; hidden: not in the help.
    """

    name: str
    kind: str
    about: str
    group: str = ""
    default: object = None
    flags: tuple[str, ...] = ()
    metavar: str = ""
    words: tuple[str, ...] = ()
    is_open: bool = False
    low: float | None = None
    high: float | None = None
    in_rig: bool = True
    hidden: bool = False
    shown_default: bool | str = True

    @property
    def long(self) -> str:
        """Its name on the command line."""
        return f"--{self.name.replace('_', '-')}"

    @property
    def bounds(self) -> str:
        """The numbers that it takes, in words."""
        kind = "a whole number" if self.kind == WHOLE else "a number"
        if self.high is None:
            return f"{kind} of {self.low or 0:g} or more"
        return f"{kind} from {self.low or 0:g} to {self.high:.10g}"


def _group(title: str, *options: Option) -> tuple[Option, ...]:
    """Options of a group of the help; flags are false unless given."""
    return tuple(
        replace(one, group=title, default=False if one.kind == FLAG else one.default)
        for one in options
    )


CONVERT: Final = (
    *_group(
        "Input",
        Option("rig", PATH, "Rig file (YAML).", flags=("-r",), metavar="FILE", in_rig=False),
        Option(
            "dataset",
            TEXT,
            "Rig of a public dataset, by name (mlbatch datasets).",
            metavar="NAME",
            in_rig=False,
        ),
        Option(
            "metadata",
            PATHS,
            "Metadata or calibration; repeatable.  [default: next to RECORDING]",
            flags=("-m",),
            metavar="FILE",
            in_rig=False,
        ),
        Option(
            "decode",
            TEXTS,
            "KEY=VALUE for decoders: crc=check, firing_azimuth=off; repeatable.",
            metavar="KEY=VALUE",
        ),
        Option("identity_extrinsics", FLAG, "Sensors without extrinsics: at 0, 0, 0."),
    ),
    *_group(
        "Batching",
        Option(
            "batching",
            TEXT,
            "window; or frame-level fusion of sweeps, as drivers and message filters give: "
            "latest, approximate, collate.",
            default="window",
            metavar="POLICY",
            words=BATCHINGS,
        ),
        Option(
            "batching_times",
            TEXT,
            "Times of points in fused sweeps: from the start of the set (common), or of their "
            "own sweep, as drivers give them (own).",
            default="common",
            words=BATCHING_TIMES,
        ),
        Option(
            "deskew",
            TEXT,
            "Move points to one instant of their window by poses: imu, a trajectory (FILE.tum: "
            "time x y z qx qy qz qw of the body), or constant-velocity, estimated from the "
            "points.",
            metavar="SOURCE",
        ),
        Option(
            "deskew_to",
            TEXT,
            "Instant of the window that points are moved to.  [default: start]",
            words=INSTANTS,
        ),
        Option(
            "rate",
            TEXT,
            "Scan rate, Hz: 10, 29.97, 10/3.  [default: rig's, or 10]",
            metavar="HZ",
            in_rig=False,
        ),
        Option(
            "slices",
            WHOLE,
            "Sub-scans per window, published one by one.",
            default=1,
            metavar="N",
            low=1,
            high=10000,
        ),
        Option("split", FLAG, "One scan per sensor instead of merged ones."),
        Option(
            "max_wait",
            TEXT,
            "Idle-source timeout: wait for a silent sensor, s, or inf.",
            default="1.0",
            metavar="S",
        ),
        Option("keep_partial", FLAG, "Also write the first and last, partial window."),
        Option(
            "drop_incomplete",
            NUMBER,
            "Leave out scans with fewer than P % of any sensor's columns.",
            default=0.0,
            metavar="P",
            low=0,
            high=100,
        ),
    ),
    *_group(
        "Selection",
        Option(
            "only",
            TEXTS,
            "Use this sensor (name or serial); repeatable.",
            flags=("--include-sensor",),
            metavar="NAME",
        ),
        Option(
            "ignore",
            TEXTS,
            "Leave out this sensor (name, serial number, topic or IP:PORT); repeatable.",
            flags=("--exclude-sensor",),
            metavar="NAME",
        ),
        Option(
            "start",
            TEXT,
            "First window starts at or after: epoch s, ISO time (UTC), or +S.",
            metavar="T",
        ),
        Option("end", TEXT, "Windows start before: as --start.", metavar="T"),
        Option("min_range", NUMBER, "Drop nearer points, m.", default=0.0, metavar="M", low=0),
        Option(
            "max_range",
            NUMBER,
            "Drop farther points, m.",
            default=float("inf"),
            metavar="M",
            low=0,
            shown_default="none",
        ),
        Option(
            "exclude_box",
            TEXTS,
            "Drop points in x0,y0,z0,x1,y1,z1, m, body frame; repeatable.",
            metavar="BOX",
            in_rig=False,
        ),
        Option("keep_repeated", FLAG, "Keep the second of two equal returns."),
        Option(
            "pass",
            TEXTS,
            "Copy this topic (or pattern) of a bag; repeatable.",
            flags=("--copy-topic",),
            metavar="TOPIC",
        ),
    ),
    *_group(
        "Output",
        Option(
            "output",
            PATH,
            "A .mcap or .bag file, or a folder (one file per scan).",
            flags=("-o",),
            in_rig=False,
        ),
        Option(
            "format",
            TEXT,
            "mcap, npz, webdataset, ply, pcd, las, laz, kitti, nuscenes, rosbag1, rosbag2.  "
            "[default: by OUTPUT; a folder: npz]",
            flags=("-f",),
            metavar="FORMAT",
        ),
        Option(
            "layout",
            TEXT,
            "dense: valid points only; organized: slots x columns.",
            default="dense",
            words=LAYOUTS,
        ),
        Option(
            "sort",
            TEXT,
            "Order of a scan's points: columns (time of their columns) or points.",
            default="columns",
            words=SORTS,
        ),
        Option(
            "point_layout",
            TEXT,
            "Fields of a PointCloud2 point (preset). FAST-LIO2: 128 rings at most.",
            default="standard",
            metavar="NAME",
        ),
        Option(
            "stamp",
            TEXT,
            "Instant of the window that messages are stamped with; times of points count from "
            "its start.",
            default="start",
            words=INSTANTS,
        ),
        Option(
            "ply_style",
            TEXT,
            "PLY properties: standard, cloudcompare, float (small_gicp).",
            default="standard",
            metavar="NAME",
            words=PLY_STYLES,
            is_open=True,
        ),
        Option(
            "max_bag_duration",
            NUMBER,
            "rosbag2: a new file of the bag every so many s of recording.  [default: one file]",
            default=0.0,
            metavar="S",
            low=0,
            high=2**33,
            shown_default=False,
        ),
        Option(
            "compression",
            TEXT,
            "Compression of MCAP chunks: none, lz4, zstd, or zstd:LEVEL from 1 to 22 (zstd: 1).",
            default="none",
            metavar="NAME",
            words=COMPRESSIONS,
            is_open=True,
        ),
        Option(
            "accumulate",
            PATH,
            "A map: one cloud of all scans, by --deskew FILE.tum (.laz, .las, .ply, .pcd).",
            metavar="MAP",
            in_rig=False,
        ),
        Option(
            "voxel",
            NUMBER,
            "Map with one point per cube of this edge, m.",
            metavar="M",
            in_rig=False,
        ),
        Option("crs", TEXT, "Coordinate system of the map.", metavar="EPSG:N", in_rig=False),
        Option(
            "report",
            PATH,
            "Path of the report (JSON); -: print it instead of the summary.",
            metavar="FILE",
            in_rig=False,
        ),
        Option(
            "html",
            PATH,
            "Also write a page of the run (HTML), see mlbatch report.",
            metavar="FILE",
            in_rig=False,
        ),
        Option(
            "html_scans",
            TEXT,
            "Scans on the page, with all their points.  [default: as many as 3 MB hold]",
            metavar="N|all",
            in_rig=False,
        ),
        Option("overwrite", FLAG, "Replace an existing output.", in_rig=False),
        Option("no_fsync", FLAG, "Do not wait until the output is on the disk."),
    ),
    *_group(
        "Clocks",
        Option(
            "clock",
            TEXT,
            "sensor: timestamps in the packets; host: receive times.",
            default="sensor",
            words=CLOCKS,
        ),
        Option("align_clocks", FLAG, "Map all clocks onto one; reads the recording twice."),
        Option(
            "align_to",
            TEXT,
            "host: clock of the capture host; first: of the first sensor.",
            default="host",
            words=ALIGN_TO,
        ),
        Option(
            "on_jump",
            TEXT,
            "At a clock step: error, or split into outputs named .segN.",
            default="error",
            words=ON_JUMP,
        ),
    ),
    *_group(
        "Run",
        Option(
            "dry_run",
            FLAG,
            "Do not write; print the report (with --on-jump split one line per segment).",
            in_rig=False,
        ),
        Option(
            "shard",
            TEXT,
            "Make every Nth scan only, from the Kth on; mlbatch merge joins all N shards.",
            metavar="K/N",
            in_rig=False,
        ),
        Option(
            "jobs",
            TEXT,
            "Scans made at the same time, one thread each; auto: cores, up to 4, if writing is "
            "slow.",
            default="auto",
            flags=("-j",),
            metavar="N|auto",
        ),
        Option("resume", FLAG, "Continue an interrupted run to the same OUTPUT.", in_rig=False),
        Option("strict", FLAG, "The first rejected packet or warning is an error."),
        Option(
            "no_pose_check",
            FLAG,
            "Do not compare the surfaces that lidars see, which checks their poses.",
        ),
        Option(
            "fail_on",
            TEXTS,
            "Exit with 3 beyond limits, as loss>0.1%,underfilled>0; repeatable.",
            metavar="LIMITS",
        ),
        Option(
            "fault",
            TEXTS,
            "Inject a fault, as drop:left:5% or stall:left:5s-8s; repeatable.",
            metavar="FAULT",
        ),
        Option(
            "fault_seed",
            WHOLE,
            "Seed of random faults.",
            default=0,
            metavar="N",
            low=0,
            high=2**31,
        ),
        Option("quiet", FLAG, "No summary, no progress.", flags=("-q",)),
        Option("verbose", FLAG, "Also print what was found and chosen.", flags=("-v",)),
        # Of the time of two engines.
        Option("engine", TEXT, "Ignored.", default="", hidden=True),
    ),
)
BY_NAME: Final = {option.name: option for option in CONVERT}
# Options that a batch passes on; it has the others itself, or they suit one session only.
_NOT_PASSED = (
    *("output", "rig", "dataset", "jobs", "only", "overwrite", "resume", "quiet", "verbose"),
    *("report", "html", "dry_run", "shard", "accumulate", "voxel", "crs"),
)
BATCH: Final = tuple(option for option in CONVERT if option.name not in _NOT_PASSED)
