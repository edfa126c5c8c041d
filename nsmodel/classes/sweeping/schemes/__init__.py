"""How a step of this class is written as a nonsmooth problem."""
