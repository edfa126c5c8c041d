"""A mass on a spring with Coulomb friction, written with a relay: x' = v, v' = -x + l, l in -Sgn(v).

What to see: the amplitude falls by 2 in each half swing until the mass stays where the spring is too weak to move it,
|x| <= 1; from then on the multiplier lies inside (-1, 1). See friction_oscillator for the same physics stepped by
the inertial proximal method.

A wrong answer: a multiplier that chatters between -1 and 1 where the mass sticks, from 22.42 s on, or a position that
creeps from 0.682 to 0. Swings that shrink by a factor are those of viscous damping.

Source: the FrictionOscillator example of Siconos.
"""

from nsmodel import LureSystem, relay

model = LureSystem(
    A=[[0, 1], [-1, 0]],
    B=[0, 1],
    C=[0, 1],
    law=relay(1),
    x0=[12, 6],
    t_end=100,
    step=1e-2,
    theta=0.5,
    names=["position", "speed"],
    units={"t": "s", "position": "m", "speed": "m/s", "l_0": "N"},
    title="Oscillator with dry friction, relay form",
)
