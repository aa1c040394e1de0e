"""Videos of runs on the test site: frames with marker, floor, perspective and lens distortion.

Drawing needs OpenGL without a screen: EGL, which runs in software if there is no graphics card.
Simulations without videos need no OpenGL.
"""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float

from slipid.data.floor_map import FloorMap
from slipid.data.wheel_signals import interpolate
from slipid.lab.testsite.robot_build import mjcf
from slipid.lab.testsite.site import Site, SiteCamera
from slipid.support.errors import DataError
from slipid.support.extras import missing

Pose = Float[np.ndarray, "3"]
Angles = Float[np.ndarray, " wheel"]
MARKER = 0
"""Number of the marker in ArUco's dictionary 4X4_50, as on the Robotino of the published frames."""

DRAWN_SHARE = 1.12
"""Size of the drawing relative to the image; lens distortion brings some of its margin into view.
"""

_SHIFT = 97
"""Range of the random shift of the noise pattern from frame to frame, along each edge [pixel]."""


class Studio:
    """Camera above a robot on a floor, which draws frames.

    Args:
        site: robot and surfaces.
        load: name of the load set-up.
        floor: map of the floor.
        camera: the camera.
        seed: seed of floor pattern, light and noise.

    Raises:
        DataError: OpenGL or OpenCV is missing.
    """

    def __init__(self, site: Site, load: str, floor: FloorMap, camera: SiteCamera, seed: int = 0):
        mujoco, cv2 = _drawing_modules()
        self.camera, self._rng, self._cv2 = camera, np.random.default_rng(seed), cv2
        (x, y), half = camera.centre_m, 0.65 * camera.height_m / camera.focal_px
        wide, high = half * camera.width_px, half * camera.height_px
        x0, y0, x1, y1 = x - wide, y - high, x + wide, y + high  # the visible floor and a margin
        carpet = _carpet(floor, site, (x0, y0, x1, y1), self._rng)
        assets = {"floor.png": _png(cv2, carpet), "marker.png": _png(cv2, _marker(cv2))}
        fovy = np.degrees(2 * np.arctan(0.5 * DRAWN_SHARE * camera.height_px / camera.focal_px))
        # turn OpenCV's camera axes into those of MuJoCo's cameras, which look along -z with y up
        axes = camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
        frame = " ".join(str(float(v)) for v in (*axes[:, 0], *axes[:, 1]))
        place = " ".join(str(float(v)) for v in camera.place)
        width, height = self._size
        looks = (
            f'<visual><global offwidth="{width}" offheight="{height}"/><quality offsamples="0"/>'
            '<headlight ambient=".42 .42 .42" diffuse=".2 .2 .2" '
            'specular="0 0 0"/><map znear=".05"/></visual><asset>'
            '<texture name="floor" type="2d" file="floor.png"/>'
            '<texture name="marker" type="2d" file="marker.png"/>'
            '<material name="floor" texture="floor" specular="0"/>'
            '<material name="marker" texture="marker" specular="0"/></asset>'
        )
        xml = mjcf(site.robot, load, 1e-3, looks=looks, floor_looks='rgba="0 0 0 0"')
        extra = (
            f'<geom type="plane" pos="{0.5 * (x0 + x1)} {0.5 * (y0 + y1)} .0002" '
            f'size="{0.5 * (x1 - x0)} {0.5 * (y1 - y0)} .1" material="floor" contype="0" '
            f'conaffinity="0"/><camera name="overhead" pos="{place}" xyaxes="{frame}" '
            f'fovy="{fovy}"/><light pos="0.6 0.4 3" dir="-.2 -.13 -1" diffuse=".35 .35 .35" '
            'castshadow="false"/>'
        )
        xml = xml.replace("<worldbody>", f"<worldbody>{extra}", 1)
        xml = xml.replace('<geom name="marker" ', '<geom name="marker" material="marker" ')
        self.model = mujoco.MjModel.from_xml_string(xml, assets)
        self.data = mujoco.MjData(self.model)
        self._forward = mujoco.mj_forward
        wheels = range(len(site.robot.places))
        self._drive_of = list(site.robot.drive_of)
        self._wheels = [self.model.joint(f"wheel{k}").qposadr[0] for k in wheels]
        try:
            self._renderer = mujoco.Renderer(self.model, height, width)
        except Exception as error:
            raise _drawing_error(error) from error
        self._distortion = self._lens()
        self._light = self._rng.uniform(0, 2 * np.pi, 2)
        size = (camera.height_px + _SHIFT, camera.width_px + _SHIFT, 3)
        self._grain = camera.noise * self._rng.standard_normal(size, np.float32)

    @property
    def _size(self) -> tuple[int, int]:
        """Width and height of the drawing before lens distortion is applied [pixel]."""
        return round(DRAWN_SHARE * self.camera.width_px), round(DRAWN_SHARE * self.camera.height_px)

    def close(self) -> None:
        """Release the drawing context."""
        self._renderer.close()

    def frame(self, pose: Pose, wheel_angle: Angles) -> np.ndarray:
        """Return an image of the robot with lens distortion, without blur and noise.

        The array has shape (row, column, 3), with blue, green and red.
        """
        q = self.data.qpos
        q[:2], q[3], q[6] = pose[:2], np.cos(0.5 * pose[2]), np.sin(0.5 * pose[2])
        q[self._wheels] = wheel_angle[self._drive_of]
        self._forward(self.model, self.data)
        self._renderer.update_scene(self.data, "overhead")
        drawn = np.ascontiguousarray(self._renderer.render()[:, :, ::-1])
        return self._cv2.remap(drawn, *self._distortion, self._cv2.INTER_LINEAR)

    def exposed(self, time: float, at: Callable[[float], tuple[Pose, Angles]]) -> np.ndarray:
        """Return a frame with motion blur, lens blur, flicker and noise.

        Args:
            time: middle of the exposure [s].
            at: function that gives the pose [m, m, rad] and the wheel angles [rad] at a time.
        """
        c = self.camera
        ends = (-0.5, 0.5) if c.exposure_s > 0 else (0.0,)
        images = [self.frame(*at(t)) for t in (time + c.exposure_s * np.array(ends))]
        image = np.mean(images, axis=0, dtype=np.float32)
        if c.blur_px > 0:
            image = self._cv2.GaussianBlur(image, (0, 0), c.blur_px)
        fast, slow = np.sin(2 * np.pi * time / np.array([1.7, 7.3]) + self._light)
        image = image * (1 + c.flicker * (0.3 * fast + 0.7 * slow))
        # shift one noise pattern at random, which is faster than new noise for every frame
        row, column = self._rng.integers(_SHIFT, size=2)
        image = image + self._grain[row : row + c.height_px, column : column + c.width_px]
        return np.clip(image, 0, 255).astype(np.uint8)

    def _lens(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y, in the drawing, of the point that each pixel of the image shows."""
        c, cv2 = self.camera, self._cv2
        grid = np.stack(np.meshgrid(np.arange(c.width_px), np.arange(c.height_px)), -1)
        points = grid.reshape(-1, 1, 2).astype(np.float64)
        ideal = cv2.undistortPoints(points, c.matrix, np.array(c.distortion))[:, 0]
        width, height = self._size
        focal = c.focal_px * height / (DRAWN_SHARE * c.height_px)  # focal length of the drawing
        x = (focal * ideal[:, 0] + 0.5 * (width - 1)).reshape(c.height_px, c.width_px)
        y = (focal * ideal[:, 1] + 0.5 * (height - 1)).reshape(c.height_px, c.width_px)
        return x.astype(np.float32), y.astype(np.float32)


def film(
    studio: Studio, true: Mapping[str, np.ndarray], frames: Float[np.ndarray, " frame"], path: Path
) -> None:
    """Write a video of a run atomically: an interrupted call leaves no file.

    Args:
        studio: camera that draws the frames.
        true: time [s] (step,), pose (step, 3) and wheel_angle (step, wheel) of the run.
        frames: times of the video's frames [s].
        path: file of the video (.avi, Motion JPEG).
    """
    import cv2

    c = studio.camera

    def at(t: float) -> tuple[Pose, Angles]:
        moved = (true[name] for name in ("pose", "wheel_angle"))
        pose, angle = (interpolate(true["time"], x, np.array([t]))[0] for x in moved)
        return pose, angle

    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.partial.avi")
    code = cv2.VideoWriter.fourcc(*"MJPG")
    video = cv2.VideoWriter(str(unfinished), code, 1 / c.frame_s, (c.width_px, c.height_px))
    if not video.isOpened():
        raise DataError(
            f"{path}: OpenCV cannot write this video; expected a writable folder and an OpenCV "
            "with Motion JPEG"
        )
    try:
        for t in frames:
            video.write(studio.exposed(float(t), at))
        video.release()
        written = cv2.VideoCapture(str(unfinished)).get(cv2.CAP_PROP_FRAME_COUNT)
        if written != len(frames):
            raise DataError(
                f"{path}: only {written:.0f} of {len(frames)} frames were written; expected "
                "enough space on the disk"
            )
        os.replace(unfinished, path)
    finally:
        video.release()
        unfinished.unlink(missing_ok=True)


def _drawing_modules() -> tuple[ModuleType, ModuleType]:
    """Return the modules mujoco, set up to draw without a screen, and cv2."""
    if os.name == "posix" and "DISPLAY" not in os.environ:
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import cv2
        import mujoco
    except ImportError as error:
        if "EGL" in str(error) or "OpenGL" in str(error):
            raise _drawing_error(error) from error
        raise missing("testsite", "the test site's camera", error) from error
    except AttributeError as error:  # raised by PyOpenGL if libEGL is absent
        raise _drawing_error(error) from error
    return mujoco, cv2


def _drawing_error(error: Exception) -> DataError:
    return DataError(
        f"pictures cannot be drawn ({error}); expected OpenGL without a screen: MUJOCO_GL=egl "
        "and, on Debian and Ubuntu, apt-get install libegl1 libgl1-mesa-dri"
    )


def _carpet(
    floor: FloorMap, site: Site, extent: tuple[float, float, float, float], rng: np.random.Generator
) -> np.ndarray:
    """Return an image of the floor, with every surface in its colour and with random grain."""
    step = 0.002
    x = np.arange(extent[0], extent[2], step) + 0.5 * step
    y = np.arange(extent[1], extent[3], step) + 0.5 * step
    colours = [bytes.fromhex(site.surfaces[name].colour[1:]) for name in floor.surfaces]
    table = np.array([list(colour) for colour in colours], float)
    picture = table[floor.at(np.stack(np.meshgrid(x, y), -1))]
    grain = rng.normal(size=picture.shape[:2]) + 0.7 * np.sin(2 * np.pi * y / 0.012)[:, None]
    return np.clip(picture * (1 + 0.06 * grain[..., None]), 0, 255).astype(np.uint8)[::-1]


def _marker(cv2: ModuleType) -> np.ndarray:
    """Return an image of the marker; its top edge is on the right, towards the body's front."""
    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    drawn = np.rot90(cv2.aruco.generateImageMarker(book, MARKER, 480), -1)
    return np.repeat(drawn[..., None], 3, axis=2)


def _png(cv2: ModuleType, picture: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", picture[..., ::-1])[1])
