"""Camera calibration from pictures of a ChArUco board: the lens, and its place above the floor.

Heights matter. A point h above the floor, seen by a lens at a height H, appears H / (H - h) times
as far from the point below the lens as it really is. With H = 2.4 m and a marker at a height of
0.25 m, lengths are 11.6 % too long if they are computed as if the marker lay on the floor. So a
camera is calibrated on the floor, and the place of a marker is computed on the plane of its height
by `OverheadCamera.on_plane`. The height must be corrected for exactly once. The published logs of
2021 and 2022 have the opposite error: corners of the marker were corrected for its height, although
the scale had been calibrated with corners at that height that were not corrected.
"""
