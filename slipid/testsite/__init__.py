"""A virtual test site whose physics comes from MuJoCo, not from the model that slipid fits.

What the engine does: rigid bodies, passive rollers that turn and give on their mounts, contacts of
every roller with a soft floor, Coulomb friction with an elliptic cone, rolling friction. Slip is
nowhere prescribed. A wheel sinks in, several rollers share its load, each shears the floor while it
passes and slides when that is too much; what the rollers' drag needs must come from there.

What is added to the engine, in other forms than those of `slipid.model`: a floor that gives under
shear is a spring of the roller's mount whose stiffness is the floor's; compaction ahead of a sunk
wheel is a force that grows with a power of the sinkage; the floor drags on the body.

What is missing: bulldozing (no heap ahead of a wheel), memory (a rut is gone when the wheel has
left), the height of a carpet's edge, pile direction, and water.
"""
