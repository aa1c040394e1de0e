"""A virtual test site whose physics comes from MuJoCo, not from the model that slipid fits.

The robot has omni wheels, or ordinary wheels: two and a castor ball, or four (skid steering).

The engine simulates rigid bodies, passive rollers that turn and yield on their mounts, contacts of
every roller with a soft floor, Coulomb friction with an elliptic cone, and rolling friction. Slip
is not prescribed anywhere. A wheel sinks in and several rollers share its load. Each roller shears
the floor as it passes, and slides when the shear force exceeds friction; the drag of the rollers
follows from this.

Much of the slip comes from the engine's own contact law: sliding, spinning and rolling share one
friction cone, so a roller that rolls against its rolling friction creeps under any force along its
axle, in proportion to its rolling speed. On the surface `soft` the robot loses 36 % of its path
length (mean of six directions, no unevenness). The loss is 31 % if the floor does not yield under
shear, 28 % if compaction and body drag are switched off as well, and 11 % if friction is also ten
times as large. This slip is a ratio of speeds, like the creep in `slipid.model`, but follows
another formula. Sinkage comes from the engine's contact springs, whose stiffness the engine scales
with the mass of the robot: with the same `softness_m`, a heavier robot of the same build sinks in
equally deep.

Three effects are added to the engine, with other formulas than in `slipid.model`. A floor that
yields under shear is modelled by a softer spring of the roller's mount; compaction ahead of a sunk
wheel is a force that grows with a power of the sinkage; a drag force acts on the body.

Ordinary wheels are cylinders that touch the floor at their two edges, against a spring of the
floor, with the same friction sideways as ahead; how a skid-steer robot scrubs follows from this.
Where the floor yields under shear, the engine's friction gives way in proportion to force and
rolling speed (see `contacts.TreadContacts`); rolling friction acts at the axle. The two edges
matter: a wheel of a robot that turns on the spot pivots about one of them, so that the effective
track of a differential robot exceeds its track by up to the width of a wheel.

Effects that are not simulated: bulldozing (no heap ahead of a wheel), memory (a rut vanishes when
the wheel has left it), the height of a carpet's edge, pile direction, and water.
"""
