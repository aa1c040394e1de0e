"""A virtual test site whose physics comes from MuJoCo, not from the model that slipid fits.

What the engine does: rigid bodies, passive rollers that turn and give on their mounts, contacts of
every roller with a soft floor, Coulomb friction with an elliptic cone, rolling friction. Slip is
nowhere prescribed. A wheel sinks in, several rollers share its load, each shears the floor while it
passes and slides when that is too much; what the rollers' drag needs must come from there.

Much of the slip is the engine's own contact law: sliding, spinning and rolling share one friction
cone, so a roller that rolls against its rolling friction creeps under any force along its axle, in
proportion to how fast it rolls. On `soft` the robot loses 36 % of its way (mean of six directions,
no unevenness); 31 % if the floor does not give under shear, 28 % if nothing resists but contact
either, 11 % if friction is ten times as large as well. It is a slip by the ratio of speeds, as the
model's creep is, with another formula. Sinkage comes from the engine's springs, which it scales
with the robot: the same `softness_m` is as deep beneath a heavier robot of the same build.

What is added to the engine, in other forms than those of `slipid.model`: a floor that gives under
shear is a spring of the roller's mount whose stiffness is the floor's; compaction ahead of a sunk
wheel is a force that grows with a power of the sinkage; the floor drags on the body.

What is missing: bulldozing (no heap ahead of a wheel), memory (a rut is gone when the wheel has
left), the height of a carpet's edge, pile direction, and water.
"""
