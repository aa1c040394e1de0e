"""The overhead camera from pictures of a ChArUco board: its lens, and its place above the floor.

Heights matter. What lies h above the floor, where the lens hangs at a height H, appears
H / (H - h) times as far from the point below the lens as it is. With H = 2.4 m and a marker 0.25 m
up, lengths that are read as if the marker lay on the floor come out 11.6 % too long. So a camera is
calibrated on the floor, and a marker is read on its own plane: `OverheadCamera.on_plane` with the
marker's height. Exactly one correction is due. The published logs of 2021 and 2022 had this mistake
the other way: corners of the marker were shrunk by its height, but the scale had been calibrated on
corners that were not.
"""
