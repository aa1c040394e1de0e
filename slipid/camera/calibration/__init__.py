"""Camera calibration from images of a board: the lens, and its pose above the floor.

Heights matter. A point h above the floor, seen by a lens at a height H, appears H / (H - h) times
as far from the point below the lens as it really is. With H = 2.4 m and a marker at a height of
0.25 m, lengths are 11.6 % too long if they are computed as if the marker lay on the floor. So a
camera is calibrated on the floor, and the position of a marker is computed on the plane of its
height by `OverheadCamera.on_plane`. The height must be corrected for exactly once. In the published
logs of 2021 and 2022 lengths are too short, since the height was corrected for twice: the scale had
been calibrated with uncorrected corners at the marker's height, and so already contained the
correction.
"""
