"""Integrate and fire: a leaky neuron whose voltage is put back when it fires.

    tau V' = i - V;    where V comes to 1 it fires, and V is put back by 1

A state cannot jump, but what is taken off it can: V = x - z, where z is held by a block and grows by 1 at each spike. So x is
continuous, x' = (i - (x - z))/tau, and V jumps.

What to see: V rises to 1 and is put back to 0, every tau log(i/(i - 1)) = 21.97 ms; z counts the spikes, 9 in 0.2 s.

A wrong answer: V above 1 by more than a step's rise, or a spike that counts twice. By constant steps a spike is late by up to a
step; with --rtol its time is that of the crossing.

Source: Lapicque, Recherches quantitatives sur l'excitation électrique des nerfs (1907); Gerstner and Kistler, Spiking Neuron
Models (2002), 4.1.
"""

import casadi as ca

from nsmodel import FirstOrderSystem, each_step

x, z, tau, current = (ca.SX.sym(name) for name in ("x", "z", "tau", "current"))
voltage = x - z

model = FirstOrderSystem(
    x=x,
    f=(current - voltage) / tau,
    x0=0,
    blocks=[each_step("fire", memory={z: 0.0}, update={z: z + ca.if_else(voltage > 1, 1, 0)})],
    outputs={"voltage": voltage},
    parameters={tau: 20e-3, current: 1.5},
    t_end=0.2,
    step=1e-4,
    names=["charge"],
    units={"t": "s"},
    title="Integrate and fire",
)
