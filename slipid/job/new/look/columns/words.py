"""Words of column names as people use them, and what each says: the one table of them."""

import re
from dataclasses import dataclass
from difflib import get_close_matches

_TABLE: dict[str, str] = {
    # which wheel
    "side l": "left l lt lh links",
    "side r": "right r rt rh rechts",
    "end f": "front fore forward f",
    "end m": "mid middle centre center",
    "end r": "rear back hind aft b",
    "corner fl": "fl lf",
    "corner fr": "fr rf",
    "corner rl": "rl bl",
    "corner rr": "rr br",
    "kind motor": "motor motors m mot engine",
    "kind wheel": "wheel wheels whl joint joints tyre tire track",
    # what is measured
    "what time": "t time stamp timestamp times tstamp elapsed clock zeit",
    "what ticks": "tick ticks enc encoder encoders count counts counter pulse pulses cnt",
    "what position": "pos position positions pose place loc location translation p",
    "what speed": "vel velocity velocities speed speeds spd omega qd rate",
    "what w": "w",
    "what v": "v",
    "what command": "cmd command commanded set setpoint sp ref reference target des desired goal",
    "what current": "cur curr current currents amp amps i strom",
    "what torque": "torque torques tau effort efforts moment",
    "what voltage": "volt volts voltage voltages u spannung",
    "what duty": "duty pwm dutycycle throttle",
    "what battery": "bat batt battery bus supply vbat vbatt vbus ubat",
    "what rpm": "rpm",
    "what gyro": "gyro gyroscope gz",
    "what yaw": "yaw heading theta th psi bearing hdg",
    "what angle": "angle angles ang phi rot rotation rotational",
    "what linear": "linear lin",
    "what angular": "angular",
    "what orientation": "orientation quaternion quat q attitude",
    "what quaternion": "qx qy qz qw",
    "what axis": "x y z",
    # of no use to slipid, but to be known
    "not odometry": "odom odometry odo",
    "not wanted": (
        "delta diff d dt dx dy dtheta accel acc acceleration mag temp temperature std cov "
        "covariance error err sum mean row index seq id flag status roll pitch lat lon rssi step"
    ),
    # says nothing
    "noise": (
        "data field fields msg value values actual measured meas feedback fb state states link "
        "robot base body global world map camera cam mocap vicon optitrack tag marker tracker "
        "lidar slam imu header twist coordinate coordinates coord axis of the from to in at along "
        "log sensor drive shaft nsec sec secs ros"
    ),
}
"""Roles, and the words that play them."""


def _roles() -> dict[str, tuple[str, str]]:
    found = {}
    for role, words in _TABLE.items():
        name, _, value = role.partition(" ")
        found |= dict.fromkeys(words.split(), (name, value))
    return found


ROLES = _roles()
_LONG = [word for word in ROLES if len(word) >= 4]
_NEAR = 0.82
"""Likeness from which a word is taken for a misspelled one."""
_LETTERS = 3
"""Longest word that may be made of single letters alone, as wl or u1l."""


@dataclass(frozen=True)
class Words:
    """A column's name taken apart.

    Attributes:
        roles: what its words say, such as ("what", "speed"), with the word itself at the end.
        numbers: digits in it.
        unknown: words that say nothing to anybody.
        mended: words that were taken for others: written as `headng -> heading`.
    """

    roles: tuple[tuple[str, str, str], ...]
    numbers: tuple[str, ...]
    unknown: tuple[str, ...]
    mended: tuple[str, ...]

    def has(self, role: str, *values: str) -> bool:
        """Whether a word plays a role (with one of these values)."""
        return any(r == role and (not values or v in values) for r, v, _ in self.roles)

    def of(self, role: str) -> list[str]:
        """Values of a role, in the order of the words."""
        return [v for r, v, _ in self.roles if r == role]

    def words(self, *values: str) -> list[str]:
        """The words of what is measured that have one of these values."""
        return [w for r, v, w in self.roles if r == "what" and v in values]


def words_of(name: str) -> Words:
    """A column's name taken apart, misspelled words mended."""
    roles, numbers, unknown, mended = [], [], [], []
    for part in _parts(name):
        if part.isdecimal():
            numbers.append(part)
            continue
        for word in [part] if part in ROLES else _apart(part):
            near = [] if word in ROLES else get_close_matches(word, _LONG, n=1, cutoff=_NEAR)
            if word not in ROLES and (len(word) < 3 or not near):
                unknown.append(word)
                continue
            if near:
                mended.append(f"{word} -> {near[0]}")
            word = near[0] if near else word
            roles.append((*ROLES[word], word))
    return Words(tuple(roles), tuple(numbers), tuple(unknown), tuple(mended))


def _parts(name: str) -> list[str]:
    """Lower-case words and numbers: at capitals, digits and signs, `1st` as 1."""
    name = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Za-z])(?=\d)", "_", name)
    name = re.sub(r"(\d)(?:st|nd|rd|th)\b", r"\1", name.lower())
    name = re.sub(r"(?<=\d)(?=[a-z])", "_", name)
    return re.findall(r"[a-z]+|\d+", name)


def _apart(word: str) -> list[str]:
    """A word made of others, such as setvel or wl, in as few as there can be; else itself."""
    best: list[list[str] | None] = [[]] + [None] * len(word)
    for end in range(1, len(word) + 1):
        for start in range(end):
            head, tail = best[start], word[start:end]
            if head is None or tail not in ROLES:
                continue
            if best[end] is None or len(head) + 1 < len(best[end] or []):
                best[end] = [*head, tail]
    found = best[-1]
    if found is None or (len(word) > _LETTERS and any(len(part) == 1 for part in found[1:-1])):
        return [word]
    single = sum(len(part) == 1 for part in found)
    if single == len(found) > _LETTERS - 1 or (len(word) > _LETTERS and single > 1):
        return [word]
    return found
