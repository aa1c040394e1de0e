"""A virtual test site whose physics comes from MuJoCo, not from the model that slipid fits.

The engine simulates rigid bodies, passive rollers that turn and yield on their mounts, contacts of
every roller with a soft floor, Coulomb friction with an elliptic cone, and rolling friction. Slip
is nowhere prescribed. A wheel sinks in, several rollers share its load, each shears the floor while
it passes and slides when that is too much; the rollers' drag follows from there.

Much of the slip is the engine's own contact law: sliding, spinning and rolling share one friction
cone, so a roller that rolls against its rolling friction creeps under any force along its axle, in
proportion to how fast it rolls. On `soft` the robot loses 36 % of its path length (mean of six
directions, no unevenness); 31 % if the floor does not yield under shear, 28 % if also nothing but
contact resists, 11 % if friction is ten times as large as well. This slip is a ratio of speeds, as
the model's creep is, with another formula. Sinkage comes from the engine's springs, which it scales
with the robot: the same `softness_m` is as deep beneath a heavier robot of the same build.

Effects added to the engine have other forms than those of `slipid.model`: a floor that yields under
shear is a spring of the roller's mount whose stiffness is the floor's; compaction ahead of a sunk
wheel is a force that grows with a power of the sinkage; the floor drags on the body.

Missing effects: bulldozing (no heap ahead of a wheel), memory (a rut is gone when the wheel has
left), the height of a carpet's edge, pile direction, and water.
"""
