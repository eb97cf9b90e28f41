"""Calibrate a real camera: print a board, estimate the intrinsics from views of it, and the pose from its position."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import options
from cli.options import RUNNING, CellTarget, CommandGroup
from common.errors import ConfigError, UnknownName
from common.terminal import echo

if TYPE_CHECKING:
    from tools.calibration.board import Board

app = CommandGroup("Calibrate a real camera with a ChArUco board.")

BOARD_FORMATS = (".png", ".pdf")
SOURCE_HELP = "device number or path, video file, or folder of images"

Squares = Annotated[str, typer.Option("--squares", metavar="COLUMNSxROWS", help="number of squares of the board")]
Square = Annotated[str, typer.Option("--square", metavar="M", help="measured side length of a square [m]")]
Marker = Annotated[str, typer.Option("--marker", metavar="M", help="side length of a marker [m]; 0: 3/4 of a square")]
Dictionary = Annotated[str, typer.Option("--dictionary", metavar="NAME", help="dictionary of the markers: "
                                                                              "4x4_50, 5x5_50, ...")]
Legacy = Annotated[bool, typer.Option("--legacy", help="the board has the pattern of OpenCV before 4.6: with an even "
                                                       "number of rows its upper left square is white")]
Size = Annotated[str, typer.Option("--size", metavar="WxH", help="image size to request from a device [px]")]
Seconds = Annotated[str, typer.Option("--seconds", metavar="S", help="how long to read images from a device [s]")]


@app.command(name="board")
def board_command(
    output: Annotated[str, typer.Option("-o", "--output", metavar="FILE", help="a .png or .pdf file")],
    squares: Squares = "7x5", square: Square = "0.036", marker: Marker = "0", dictionary: Dictionary = "4x4_50",
    legacy: Legacy = False,
) -> None:
    """Write a board to print at 100 %; a line on it of known length shows whether the print has the right scale."""
    suffix = Path(output).suffix.lower()
    if suffix not in BOARD_FORMATS:
        raise ConfigError("--output", output, f"must end in {' or '.join(BOARD_FORMATS)}")
    board = board_of(squares, square, marker, dictionary, legacy)
    import matplotlib.image

    page, density = board.page()
    try:
        matplotlib.image.imsave(Path(output).expanduser(), page, format=suffix[1:], cmap="gray", vmin=0, vmax=255,
                                dpi=density * 0.0254)
    except OSError as error:
        raise ConfigError("--output", output, f"cannot be written: {error.strerror}") from None
    width, height = (1e3 * pixels / density for pixels in reversed(page.shape))
    echo(f"{output}: {board.options}; {width:.1f} x {height:.1f} mm. Print it at 100 %, measure the line on it, "
         "fix it to something flat.")


@app.command()
def intrinsics(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help=SOURCE_HELP)],
    output: Annotated[str, typer.Option("-o", "--output", metavar="FILE", help="YAML file to write")] = "camera.yaml",
    squares: Squares = "7x5", square: Square = "0.036", marker: Marker = "0", dictionary: Dictionary = "4x4_50",
    legacy: Legacy = False,
    views: Annotated[str, typer.Option("--views", metavar="N", help="number of distinct views to collect")] = "8",
    k_coefficients: Annotated[
        str, typer.Option("--k-coefficients", metavar="N", help="number of radial coefficients: 0 no "
                                                                "distortion, 3 wide angle, above 3 rational model")
    ] = "2",
    size: Size = "", seconds: Seconds = "60",
) -> None:
    """Estimate focal lengths, centre and distortion from tilted views of the board all over the image."""
    from common.config import check
    from common.perception.image_sources import read_images
    from tools.calibration.intrinsics import CollectingOptions, ViewSelector, calibrate_intrinsics
    from tools.calibration.report import camera_from_intrinsics, format_intrinsics

    least = options.whole("--views", views, 3) or 3
    settings = check(CollectingOptions, {"least_views": least, "most_views": max(60, least),
                                         "k_coefficients": options.whole("--k-coefficients", k_coefficients, 0)})
    collector = ViewSelector(board_of(squares, square, marker, dictionary, legacy), settings)
    terminal = sys.stderr.isatty()
    for name, image in read_images(source, parse_size(size), options.number("--seconds", seconds), warn):
        reason = collector.add(image, name)
        if terminal:
            part, unseen = collector.coverage()
            echo(f"{name}: {reason or f'view {len(collector.views)}'}; {100 * part:.0f} % of the image covered"
                 + (f", nothing {unseen[0]}" if unseen else ""), err=True)
        if collector.complete:
            break
    collector.require_enough()
    if collector.rejections:
        warn(f"left out of {collector.images} images: {collector.rejections}")
    found = calibrate_intrinsics(collector.views, settings)
    camera = camera_from_intrinsics(found, source, str(collector.board.options))
    old = Path(output).expanduser()
    if old.is_file() and "position:" in old.read_text(encoding="utf-8", errors="replace"):
        echo(f"{output} had a pose, which is removed because it belongs to other intrinsics: calibrate the pose again")
    camera.save(output)
    echo(format_intrinsics(found))
    echo(f"{output} holds the intrinsics; next: zencell calibrate pose SOURCE --intrinsics {output} ...")


@app.command()
def pose(
    sources: Annotated[list[str], typer.Argument(metavar="SOURCE...", help=f"{SOURCE_HELP}; one for each board "
                                                                           f"position")],
    intrinsics_file: Annotated[
        str, typer.Option("--intrinsics", metavar="FILE", help="YAML file of `zencell calibrate intrinsics`, "
                                                             "camera_info of ROS, or a file of OpenCV")
    ],
    board_position: Annotated[
        list[str], typer.Option("--board-position", metavar="X,Y,Z", help="lower left corner of the squares in world "
                                                                          "[m]; once for each SOURCE")
    ],
    board_rpy: Annotated[
        list[str] | None, typer.Option("--board-rpy", metavar="R,P,Y", help="rotation of the board in world "
                                                                            "[rad]; 0,0,0: face "
                                                                            "up, x along x; once, or for each SOURCE")
    ] = None,
    output: Annotated[
        str, typer.Option("-o", "--output", metavar="FILE", help="YAML file to write [the file of --intrinsics]")
    ] = "",
    squares: Squares = "7x5", square: Square = "0.036", marker: Marker = "0", dictionary: Dictionary = "4x4_50",
    legacy: Legacy = False,
    images_of_each: Annotated[
        str, typer.Option("--pictures", metavar="N", help="images of each board position, at most")
    ] = "20",
    seconds: Seconds = "10",
) -> None:
    """Estimate the pose of a fixed camera from images of a board at a measured position.

    Several board positions, far apart in the image, are much more accurate: pass SOURCE and --board-position for each.
    """
    from common.perception.camera_file import CameraFile
    from common.robot.transforms import rpy_to_matrix, transform
    from tools.calibration.camera_pose import calibrate_pose, detect_boards_in
    from tools.calibration.report import format_pose, with_pose

    file = output or _own(intrinsics_file)
    rotations = board_rpy or ["0,0,0"]
    if len(board_position) != len(sources):
        raise ConfigError("--board-position", len(board_position), f"times for {len(sources)} sources")
    if len(rotations) not in (1, len(sources)):
        raise ConfigError("--board-rpy", len(rotations), f"times for {len(sources)} sources; pass it once for "
                                                         f"all, or once for each")
    rotations = rotations * len(sources) if len(rotations) == 1 else rotations
    positions = [options.three("--board-position", text) for text in board_position]
    angles = [options.three("--board-rpy", text) for text in rotations]
    camera, board = CameraFile.load(intrinsics_file), board_of(squares, square, marker, dictionary, legacy)
    most, limit = options.whole("--pictures", images_of_each, 1) or 1, options.number("--seconds", seconds)
    places = [(transform(rpy_to_matrix(*rpy), position), detect_boards_in(source, board, camera, most, limit, warn))
              for source, position, rpy in zip(sources, positions, angles, strict=True)]
    result = calibrate_pose(places, camera)
    with_pose(camera, result, sources, positions, angles).save(file)
    echo(format_pose(result))
    echo(f"{file} holds intrinsics and pose; a cell takes both with --set world.camera={file}")


@app.command(name="hand-eye")
def hand_eye(
    folder: Annotated[str, typer.Argument(metavar="FOLDER", help="views of `zencell calibrate collect`")],
    intrinsics_file: Annotated[
        str, typer.Option("--intrinsics", metavar="FILE", help="YAML file of `zencell calibrate intrinsics`, "
                                                             "camera_info of ROS, or a file of OpenCV")
    ],
    mount: Annotated[str, typer.Option("--camera", metavar="hand|beside", help="on the hand, or fixed next to an arm "
                                                                               "that holds the board")],
    output: Annotated[
        str, typer.Option("-o", "--output", metavar="FILE", help="YAML file to write [the file of --intrinsics]")
    ] = "",
    squares: Squares = "7x5", square: Square = "0.036", marker: Marker = "0", dictionary: Dictionary = "4x4_50",
    legacy: Legacy = False,
) -> None:
    """Estimate the pose of a camera on the hand, or fixed next to an arm that holds the board."""
    from typing import get_args

    from common.config import load_robot
    from common.perception.camera_file import CameraFile
    from common.robot.model import RobotModel
    from tools.calibration.hand_eye import MIN_VIEWS, Mount
    from tools.calibration.intrinsics import CalibrationFailed
    from tools.calibration.report import format_hand_eye, with_hand_eye
    from tools.calibration.views import calibrate_views, load_views

    if mount not in get_args(Mount):
        raise UnknownName("--camera", mount, get_args(Mount))
    file = output or _own(intrinsics_file)
    camera, board = CameraFile.load(intrinsics_file), board_of(squares, square, marker, dictionary, legacy)
    views, problems, header = load_views(Path(folder).expanduser(), board, camera)
    if len(views) < MIN_VIEWS and problems:
        raise CalibrationFailed(f"{len(views)} views of the board, {MIN_VIEWS} are needed; {problems[0]}")
    for problem in problems:
        warn(problem)
    robot = RobotModel.load(load_robot(header.robot))
    result = calibrate_views(views, robot, camera, "hand" if mount == "hand" else "beside")
    with_hand_eye(camera, result, folder, header.robot, mount).save(file)
    echo(format_hand_eye(result))
    place = "the pose on the hand" if mount == "hand" else "pose"
    echo(f"{file} holds intrinsics and {place}; a cell takes both with --set world.camera={file}")
    echo(result.verdict)


@app.command()
def collect(
    folder: Annotated[str, typer.Argument(metavar="FOLDER", help="folder for the images and joint positions")],
    robot: Annotated[str, typer.Option("--robot", metavar="NAME", help="robot file of the arm in the running cell")],
    key: Annotated[str, typer.Option("--key", metavar="KEY", help="topic of the camera's images")] = "camera/image_raw",
    views: Annotated[str, typer.Option("--views", metavar="N", help="number of views to collect")] = "15",
    squares: Squares = "7x5", square: Square = "0.036", marker: Marker = "0", dictionary: Dictionary = "4x4_50",
    legacy: Legacy = False,
    at: CellTarget = RUNNING,
) -> None:
    """Save board images and joint positions of a running cell each time the arm is at standstill in a new pose.

    Move the arm by hand, by jogging or with your own script; this command moves nothing.
    """
    from common.config import load_robot
    from common.robot.model import RobotModel
    from tools.calibration.views import HandEyeCollector, collect_views

    model = RobotModel.load(load_robot(robot))
    board, needed = board_of(squares, square, marker, dictionary, legacy), options.whole("--views", views, 1) or 1
    collector = HandEyeCollector(Path(folder).expanduser(), model, robot, board)
    at.visit(lambda bus: collect_views(bus, key, collector, needed, echo))
    echo(f"{folder} holds {collector.count} views; next: zencell calibrate hand-eye {folder} --intrinsics FILE "
         "--camera hand|beside")


def _own(file: str) -> str:
    """Return a file that a pose may be added to.

    Raises:
        ConfigError: another program wrote it.
    """
    from common.perception.camera_formats import read_foreign

    if read_foreign(Path(file).expanduser()) is not None:
        raise ConfigError("--output", ..., f"is needed: {file} is of another program")
    return file


def warn(line: str) -> None:
    """Write a line to stderr."""
    echo(line, err=True)


def board_of(squares: str, square: str, marker: str, dictionary: str, legacy: bool) -> Board:
    """Return the board that the options describe.

    Raises:
        ConfigError: an option is not valid.
    """
    from typing import get_args

    from common.config import check
    from tools.calibration import board as b

    columns, rows = _two("--squares", squares, "7x5")
    if dictionary not in get_args(b.Dictionary):
        raise UnknownName("dictionary", dictionary, get_args(b.Dictionary))
    side = options.number("--square", square)
    given = options.number("--marker", marker)
    return b.Board(check(b.BoardOptions, {"columns": columns, "rows": rows, "square": side,
                                          "marker": given or round(0.75 * side, 6), "dictionary": dictionary,
                                          "legacy": legacy}, "board"))


def parse_size(text: str) -> tuple[int, int] | None:
    """Parse `WxH` to width and height [px]; empty text gives None.

    Raises:
        ConfigError: the text has another form.
    """
    return _two("--size", text, "640x480") if text else None


def _two(option: str, text: str, example: str) -> tuple[int, int]:
    first, found, second = text.lower().partition("x")
    if not found or not first.isdecimal() or not second.isdecimal():
        raise ConfigError(option, text, f"must be two whole numbers, as {example}")
    return int(first), int(second)
