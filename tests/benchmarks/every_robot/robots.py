"""Thirty made robots: what is true of each, and what its user believes and writes in the config.

Nothing here or in the modules beside it comes from slipid, so that no mistake of slipid can hide in
the robots that judge it. Lengths are in metres, angles in radians, times in seconds.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Grip:
    """Friction from which slip follows that depends on the direction of travel and on the loads.

    Attributes:
        loads: share of the weight on each wheel.
        creep: slip speed over rim speed at which friction is nearly full.
        drag: friction along the free direction of the rollers over that along their axles.
    """

    loads: tuple[float, ...]
    creep: float = 0.25
    drag: float = 0.15


@dataclass(frozen=True)
class Floor:
    """True kinematics on one floor.

    Attributes:
        name: name of the floor.
        radius: effective rolling radius of each drive; a constant slip is in it.
        base: effective track; wheelbase of a steered robot; lx + ly of mecanum wheels; distance of
            omni wheels from the middle.
        centre: centre of rotation ahead of the middle (of the axle).
        grip: friction, for floors on which slip depends on the direction of travel.
        understeer: K in yaw rate = v tan(d) / (base + K v^2) [s^2/m].
    """

    name: str
    radius: tuple[float, ...]
    base: float
    centre: float = 0.0
    grip: Grip | None = None
    understeer: float = 0.0


@dataclass(frozen=True)
class Motors:
    """True motors: U = R I + C_e n w, and torque at the wheel = C_e n I."""

    resistance: float
    back_emf: float
    gear: float
    coulomb: float
    viscous: float
    inertia: float


@dataclass(frozen=True)
class MadeRobot:
    """The truth of one robot, and the numbers that its user writes in the config.

    Attributes:
        name: name of the robot.
        drive: "differential", "skid", "omni", "mecanum" or "steered".
        floors: true kinematics on each floor.
        nominal_radius: wheel radius in the config.
        nominal_base: track or base in the config, meaning as in `Floor`.
        azimuths_deg: directions from the middle to omni wheels.
        half_length: half the distance between the axles of skid and mecanum robots.
        driven: driven axle of a steered robot, "rear" or "front" (which is then steered, too).
        steering_zero, steering_gain: true steering angle = gain (logged - zero).
        place: pose sensor ahead and left of the middle (of the rear or only axle).
        yaw: heading of the pose sensor in the robot.
        lag: age of a pose when its row is written.
        pose_kind: "pose", "xy" or "heading".
        pose_every: a pose stands in every so many rows.
        noise_m, noise_rad: standard deviations of a pose.
        rate: rows per second.
        only_changes: rows stand only where something rounded changed.
        ticks: encoder ticks per wheel turn, 0 for exact angles.
        wheel_noise: standard deviation of the share of a wheel's turn that slips at random.
        gyro: whether a gyro is logged.
        rest: time at rest at both ends of a run.
        speed, turn_rate: usual speed [m/s] and yaw rate [rad/s].
        paths: "mixed", "squares" or "straight" training runs.
        runs: training runs on each floor.
        wrong_label: whether one training run lies in the folder of another floor.
        motors: motors, if currents and voltages are logged.
        mass: mass [kg].
    """

    name: str
    drive: str
    floors: tuple[Floor, ...]
    nominal_radius: float
    nominal_base: float
    azimuths_deg: tuple[float, ...] = ()
    half_length: float = 0.15
    driven: str = "rear"
    steering_zero: float = 0.0
    steering_gain: float = 1.0
    place: tuple[float, float] = (0.0, 0.0)
    yaw: float = 0.0
    lag: float = 0.0
    pose_kind: str = "pose"
    pose_every: int = 1
    noise_m: float = 0.001
    noise_rad: float = 0.002
    rate: float = 50.0
    only_changes: bool = False
    ticks: int = 0
    wheel_noise: float = 0.005
    gyro: bool = False
    rest: float = 0.0
    speed: float = 0.3
    turn_rate: float = 0.8
    paths: str = "mixed"
    runs: int = 6
    wrong_label: bool = False
    motors: Motors | None = None
    mass: float = 10.0

    @property
    def drives(self) -> int:
        return len(self.floors[0].radius)

    @property
    def has_kinematics(self) -> bool:
        """True if radii and bases are all there is to know: no floor makes load-dependent slip."""
        return all(floor.grip is None for floor in self.floors)

    @property
    def determined(self) -> bool:
        """True if kinematics are all there is to know, and the training runs show all of them."""
        told = self.paths != "straight" and self.pose_kind != "heading" and not self.wrong_label
        return told and self.has_kinematics

    def floor(self, name: str) -> Floor:
        return next(floor for floor in self.floors if floor.name == name)


OMNI3, OMNI4 = (60.0, 180.0, 300.0), (45.0, 135.0, 225.0, 315.0)
MOTORS = Motors(0.9, 0.045, 12.0, 0.06, 0.012, 0.02)


def equal_wheels(
    name: str,
    radius: float,
    drives: int,
    base: float,
    centre: float = 0.0,
    grip: Grip | None = None,
    understeer: float = 0.0,
) -> Floor:
    """Return a floor on which all drives have one radius."""
    return Floor(name, (radius,) * drives, base, centre, grip, understeer)


ROBOTS = (
    MadeRobot(
        "diff_right",
        "differential",
        (equal_wheels("floor", 0.05, 2, 0.30),),
        0.05,
        0.30,
        ticks=4096,
    ),
    MadeRobot(
        "diff_umbmark",  # unequal wheels and a wrong track, squares both ways
        "differential",
        (Floor("floor", (0.03267, 0.03333), 0.170),),
        0.033,
        0.160,
        ticks=4096,
        paths="squares",
        speed=0.2,
    ),
    MadeRobot(
        "diff_only_changes",
        "differential",
        (equal_wheels("carpet", 0.0523, 2, 0.605),),
        0.0508,
        0.56,
        only_changes=True,
        paths="squares",
        noise_m=0.0002,
        noise_rad=0.0003,
        speed=0.5,
        mass=50,
    ),
    MadeRobot(
        "diff_positions",  # a satellite antenna: no heading
        "differential",
        (equal_wheels("yard", 0.102, 2, 0.42),),
        0.10,
        0.40,
        place=(0.15, 0.0),
        lag=0.1,
        pose_kind="xy",
        pose_every=5,
        noise_m=0.005,
        speed=0.6,
    ),
    MadeRobot(
        "diff_wrong_label",  # one run on tile lies in the folder of carpet
        "differential",
        (equal_wheels("carpet", 0.0485, 2, 0.310), equal_wheels("tile", 0.050, 2, 0.302)),
        0.05,
        0.30,
        ticks=2048,
        wrong_label=True,
    ),
    MadeRobot(
        "diff_motors",
        "differential",
        (equal_wheels("floor", 0.0762, 2, 0.36),),
        0.0762,
        0.35,
        ticks=8192,
        rest=1.0,
        motors=MOTORS,
    ),
    MadeRobot(
        "diff_own",
        "differential",
        (equal_wheels("carpet", 0.0757, 2, 0.448), equal_wheels("tile", 0.0770, 2, 0.448)),
        0.0762,
        0.46,
        place=(0.060, 0.010),
        lag=0.040,
        ticks=8192,
        rest=1.0,
        motors=MOTORS,
        noise_rad=0.001,
        wheel_noise=0.003,
    ),
    MadeRobot(
        "diff_coarse_ticks",  # least squares finds a lag of 0.4 rows here, and there is none
        "differential",
        (equal_wheels("floor", 0.0335, 2, 0.152),),
        0.0325,
        0.16,
        ticks=40,
        speed=0.25,
        mass=1.5,
    ),
    MadeRobot(
        "diff_low_rate",
        "differential",
        (equal_wheels("floor", 0.0765, 2, 0.34),),
        0.075,
        0.33,
        rate=5.0,
        pose_every=2,
        noise_m=0.003,
        place=(-0.05, 0.0),
    ),
    MadeRobot(
        "diff_large_lag",
        "differential",
        (equal_wheels("floor", 0.098, 2, 0.39),),
        0.10,
        0.40,
        lag=0.6,
        pose_every=5,
        rest=1.0,
        speed=0.5,
    ),
    MadeRobot(
        "diff_straight",  # no turns at all: the track must stay as it is given
        "differential",
        (Floor("floor", (0.0512, 0.0508), 0.30),),
        0.05,
        0.31,
        ticks=4096,
        paths="straight",
    ),
    MadeRobot(
        "diff_heading",  # a compass alone: tells the ratio of the radii, and of radius and track
        "differential",
        (Floor("floor", (0.0505, 0.0495), 0.315),),
        0.05,
        0.30,
        pose_kind="heading",
        gyro=True,
        noise_rad=0.01,
    ),
    MadeRobot(
        "skid_two_floors",
        "skid",
        (
            equal_wheels("asphalt", 0.165, 2, 0.825, centre=-0.03),
            equal_wheels("grass", 0.158, 2, 0.99, centre=-0.09),
        ),
        0.165,
        0.55,
        half_length=0.256,
        place=(0.1, 0.0),
        lag=0.08,
        pose_every=4,
        noise_m=0.004,
        speed=0.8,
        mass=50,
    ),
    MadeRobot(
        "skid_lidar",
        "skid",
        (equal_wheels("gravel", 0.152, 2, 0.86, centre=-0.05),),
        0.15,
        0.60,
        half_length=0.25,
        place=(0.32, 0.05),
        yaw=0.03,
        lag=0.25,
        rate=20.0,
        pose_every=2,
        noise_m=0.01,
        noise_rad=0.004,
        wheel_noise=0.03,
        speed=0.8,
        mass=60,
    ),
    MadeRobot(
        "skid_load_slip",
        "skid",
        (equal_wheels("grass", 0.16, 2, 0.5, grip=Grip((0.22, 0.22, 0.28, 0.28), 0.1, 1.0)),),
        0.16,
        0.50,
        half_length=0.2,
        rate=20.0,
        noise_m=0.005,
        speed=0.6,
        mass=40,
    ),
    MadeRobot(
        "omni3_right",
        "omni",
        (equal_wheels("table", 0.04, 3, 0.125),),
        0.04,
        0.125,
        azimuths_deg=OMNI3,
        ticks=8192,
    ),
    MadeRobot(
        "omni3_wrong_base",
        "omni",
        (Floor("floor", (0.0515, 0.0510, 0.0507), 0.202),),
        0.051,
        0.195,
        azimuths_deg=OMNI3,
        ticks=4096,
        rate=25.0,
        speed=0.4,
    ),
    MadeRobot(
        "omni3_two_floors",  # a constant slip of 8 % on the soft floor
        "omni",
        (equal_wheels("hard", 0.04, 3, 0.125), equal_wheels("soft", 0.0368, 3, 0.127)),
        0.04,
        0.125,
        azimuths_deg=OMNI3,
        gyro=True,
    ),
    MadeRobot(
        "omni3_marker",
        "omni",
        (equal_wheels("floor", 0.0403, 3, 0.131),),
        0.04,
        0.125,
        azimuths_deg=OMNI3,
        place=(0.08, -0.03),
        yaw=0.09,
        lag=0.056,
    ),
    MadeRobot(
        "omni3_load_slip",
        "omni",
        (
            equal_wheels("gray", 0.04, 3, 0.125, grip=Grip((0.26, 0.40, 0.34), 0.3, 0.3)),
            equal_wheels("green", 0.04, 3, 0.125, grip=Grip((0.26, 0.40, 0.34), 0.7, 0.4)),
        ),
        0.04,
        0.125,
        azimuths_deg=OMNI3,
        mass=12,
    ),
    MadeRobot(
        "omni4_wrong_base",
        "omni",
        (equal_wheels("floor", 0.0492, 4, 0.212),),
        0.05,
        0.20,
        azimuths_deg=OMNI4,
        place=(0.05, 0.05),
        ticks=2048,
    ),
    MadeRobot(
        "omni4_load_slip",
        "omni",
        (equal_wheels("felt", 0.05, 4, 0.20, grip=Grip((0.18, 0.32, 0.29, 0.21), 0.6, 0.3)),),
        0.05,
        0.20,
        azimuths_deg=OMNI4,
    ),
    MadeRobot(
        "mecanum_wrong_base",
        "mecanum",
        (equal_wheels("floor", 0.0675, 4, 0.36),),
        0.07,
        0.385,
        half_length=0.2,
        ticks=1000,
        lag=0.03,
        noise_m=0.002,
    ),
    MadeRobot(
        "mecanum_two_floors",
        "mecanum",
        (equal_wheels("tile", 0.0502, 4, 0.31), equal_wheels("rug", 0.0478, 4, 0.325)),
        0.05,
        0.30,
        half_length=0.16,
        gyro=True,
        place=(-0.07, 0.0),
    ),
    MadeRobot(
        "mecanum_load_slip",
        "mecanum",
        (equal_wheels("rug", 0.05, 4, 0.30, grip=Grip((0.22, 0.23, 0.27, 0.28), 0.25)),),
        0.05,
        0.30,
        half_length=0.16,
    ),
    MadeRobot(
        "tricycle_front",  # the steered front wheel drives
        "steered",
        (equal_wheels("hall", 0.122, 1, 1.05),),
        0.125,
        1.0,
        driven="front",
        steering_zero=0.02,
        place=(0.5, 0.0),
        lag=0.1,
        rate=20.0,
        noise_m=0.005,
        speed=0.7,
        mass=200,
    ),
    MadeRobot(
        "bicycle_zero",  # zero offset and gain of the steering
        "steered",
        (equal_wheels("floor", 0.033, 1, 0.256),),
        0.0325,
        0.256,
        steering_zero=-0.035,
        steering_gain=0.9,
        ticks=1000,
        speed=0.5,
        mass=3,
    ),
    MadeRobot(
        "ackermann_car",  # two rear wheels with an encoder each
        "steered",
        (equal_wheels("asphalt", 0.0318, 2, 0.33),),
        0.0325,
        0.324,
        steering_zero=0.015,
        steering_gain=1.06,
        place=(0.2, 0.0),
        lag=0.05,
        speed=0.8,
        mass=4,
    ),
    MadeRobot(
        "ackermann_understeer",
        "steered",
        (equal_wheels("asphalt", 0.0525, 2, 0.33, understeer=0.03),),
        0.05,
        0.33,
        steering_zero=0.01,
        lag=0.12,
        pose_every=5,
        noise_m=0.01,
        speed=1.5,
        mass=6,
    ),
    MadeRobot(
        "ackermann_two_floors",
        "steered",
        (equal_wheels("asphalt", 0.051, 2, 0.40), equal_wheels("gravel", 0.0495, 2, 0.43)),
        0.05,
        0.40,
        steering_zero=0.02,
        pose_every=2,
        speed=0.8,
        mass=6,
    ),
)
"""Every robot of the proving ground."""
