"""`zencell export`: writes recordings in the formats of other programs, and reports what each cannot hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from common.errors import ConfigError
from common.terminal import Progress, echo, printable
from recording.datasets.command import DatasetOptions, write_lerobot, write_robomimic
from recording.datasets.manifest import read_manifest
from recording.datasets.topic_files import write_numpy, write_parquet
from recording.export import export_images, export_tables, export_video, file_names, image_topics
from recording.formatting import format_bytes, require_new
from recording.foxglove import export_foxglove
from recording.reader import Recording
from recording.sample import Decoder
from recording.selection import Selection

FORMATS = ("--foxglove OUT.mcap, --csv DIR, --images DIR, --video OUT.mp4, --lerobot DIR, --hdf5 OUT.hdf5, "
           "--parquet DIR, --numpy DIR")
FILES = {"--foxglove": ".mcap", "--video": ".mp4", "--hdf5": ".hdf5"}  # formats of one new file
FOLDERS = ("--csv", "--images", "--parquet", "--numpy")
ONE_RECORDING = ("--foxglove", "--csv", "--images", "--video")
WHOLE = {"--lerobot": write_lerobot, "--hdf5": write_robomimic}  # formats of all recordings together


@dataclass(frozen=True)
class ExportRequest:
    """Recordings, and the target of each wanted format by its option.

    A folder of demonstrations means the recordings of its manifest that succeeded, or all with `failures`.
    """

    files: list[str]
    targets: dict[str, str]
    selection: Selection
    dataset: DatasetOptions = field(default_factory=DatasetOptions)
    failures: bool = False


def export(request: ExportRequest) -> None:
    """Write every wanted format, and print what was written and left out.

    Raises:
        ConfigError: there is no format, or a target, option or recording does not fit it.
        RecordingError: a recording is damaged.
    """
    if not request.targets:
        raise ConfigError("export", ..., f"needs one or more of {FORMATS}")
    request = _with_episodes(request)
    stems = [Path(file).stem for file in request.files]
    for option, target in request.targets.items():
        _require_target(option, Path(target), len(request.files))
        if option in FOLDERS and len(set(stems)) < len(stems):
            raise ConfigError(option, target, "has a folder for each recording: two recordings have the same name")
    for option, write in WHOLE.items():
        if option in request.targets:
            paths = [Path(file) for file in request.files]
            write(paths, Path(request.targets[option]), request.selection, request.dataset, echo)
    for file in request.files:
        _export_one(request, file)


def _with_episodes(request: ExportRequest) -> ExportRequest:
    """Return the request with the episodes and tasks of folders of demonstrations.

    Raises:
        ConfigError: a folder has no valid manifest, or no episode to export.
    """
    files, tasks = list[str](), list[str]()
    for given in request.files:
        if not Path(given).is_dir():
            files.append(given)
            tasks.append("")
            continue
        episodes = read_manifest(Path(given)).episodes
        chosen = [each for each in episodes if each.success or request.failures]
        if not chosen:
            raise ConfigError("FILE", given, "has no episode that succeeded; --failures exports the others")
        if len(chosen) < len(episodes):
            echo(f"{given}: {len(episodes) - len(chosen)} failed episodes left out; --failures exports them")
        files += [str(Path(given) / each.file) for each in chosen]
        tasks += [each.task for each in chosen]
    given_tasks = request.dataset.tasks or (tasks if any(tasks) else ())
    return replace(request, files=files, dataset=replace(request.dataset, tasks=given_tasks))


def _require_target(option: str, target: Path, recordings: int) -> None:
    if recordings > 1 and option in ONE_RECORDING:
        raise ConfigError(option, str(target), f"takes one recording, not {recordings}")
    if option in FILES:
        require_new(target, option, FILES[option])
    if option in FOLDERS and target.exists() and not target.is_dir():
        raise ConfigError(option, str(target), "must be a folder")


def _export_one(request: ExportRequest, file: str) -> None:
    """Write the formats that hold the topics of one recording; several recordings have a folder each."""
    with Progress(f"reading {file}") as read, Recording(Path(file), read) as recording:
        request.selection.require_in(recording.topics(), recording.path, "--topics")
        for option, write in WRITERS.items():
            if option not in request.targets:
                continue
            target = Path(request.targets[option])
            target = target / Path(file).stem if len(request.files) > 1 else target
            decoder = Decoder()
            write(recording, target, request.selection, decoder)
            for counts, why in ((decoder.skipped, "this version does not know their type"),
                                (decoder.unfit, f"{option} cannot hold them")):
                for topic, count in sorted(counts.items()):
                    echo(f"{printable(topic)}: {count:,} messages left out: {why}", err=True)
        if recording.flaw:
            echo(f"the recording is {recording.flaw}; to repair it: zencell recover {file}", err=True)


def _foxglove(recording: Recording, target: Path, selection: Selection, decoder: Decoder) -> None:
    count = export_foxglove(recording, target, selection.wants, decoder)
    echo(f"{target}: {count:,} messages, {format_bytes(target.stat().st_size)}, for Foxglove")


def _tables(recording: Recording, folder: Path, selection: Selection, decoder: Decoder) -> None:
    for name, count in export_tables(recording, folder, selection.wants, decoder).items():
        echo(f"{folder / name}: {count:,} rows")


def _parquet(recording: Recording, folder: Path, selection: Selection, decoder: Decoder) -> None:
    for name, count in write_parquet(recording, folder, selection.wants, decoder).items():
        echo(f"{folder / name}: {count:,} rows")


def _numpy(recording: Recording, folder: Path, selection: Selection, decoder: Decoder) -> None:
    for name, count in write_numpy(recording, folder, selection.wants, decoder).items():
        echo(f"{folder / name}: {count:,} rows")


def _images(recording: Recording, folder: Path, selection: Selection, decoder: Decoder) -> None:
    if not image_topics(recording, selection.wants):
        raise ConfigError("--images", str(recording.path), "has no images among the selected topics")
    names = file_names(image_topics(recording, selection.wants))
    for topic, count in export_images(recording, folder, selection.wants, decoder).items():
        echo(f"{folder / names[topic]}: {count:,} images")


def _video(recording: Recording, target: Path, selection: Selection, decoder: Decoder) -> None:
    choices = image_topics(recording, selection.wants)
    if len(choices) != 1:
        named = ", ".join(choices) or "none"
        raise ConfigError("--video", str(target), f"needs one topic with images, by --topics KEY; choices: {named}")
    count, rate = export_video(recording, target, choices[0], decoder)
    echo(f"{target}: {count:,} images of {choices[0]} at {rate:g} Hz")


WRITERS: dict[str, Callable[[Recording, Path, Selection, Decoder], None]] = {
    "--foxglove": _foxglove, "--csv": _tables, "--images": _images, "--video": _video, "--parquet": _parquet,
    "--numpy": _numpy}
