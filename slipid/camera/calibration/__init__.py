"""Camera calibration from pictures of a ChArUco board: the lens, and its place above the floor.

Heights matter. A point h above the floor, seen by a lens at a height H, appears H / (H - h) times
as far from the point below the lens as it is. With H = 2.4 m and a marker 0.25 m up, lengths read
as if the marker lay on the floor are 11.6 % too long. So a camera is calibrated on the floor, and a
marker is read on its own plane: `OverheadCamera.on_plane` with the marker's height. Exactly one
correction is due. The published logs of 2021 and 2022 had this mistake the other way: corners of
the marker were shrunk by its height, but the scale had been calibrated on corners that were not.
"""
