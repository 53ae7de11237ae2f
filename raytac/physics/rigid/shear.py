"""Shear of the gel under contacts: elastic stretch with partial slip, and its memory.

A contact of normal load N carries a tangential force by shearing first. Cattaneo and Mindlin's contact of two spheres obeys

    T = μN (1 − (1 − u/u₀)^(3/2)),   u₀ = 3 μN / (2 k)

with u the tangential displacement and k the stiffness without slip; its outer annulus slips, the disc of radius c = a (1 − T/μN)^(1/3)
sticks. Here rings in parallel give that curve (W. D. Iwan, A distributed-element model for hysteresis, J. Appl. Mech. 33, 1966): one with
the share y of the stiffness k inside it slips at u₀ (1 − y²). They remember: unloading and reversal follow Masing's rule, as Mindlin and
Deresiewicz' contact does (J. Appl. Mech. 20, 1953).

Rings stay where they are on the gel. Under a normal load that grows the contact gets rings without stretch, and under one that falls it
loses the outermost with theirs, while those within keep their stretch. This is how independent springs along the radius behave, which
are exact for axisymmetric contacts at any history (V. L. Popov and M. Heß, Method of Dimensionality Reduction, 2015). So a load that
vibrates moves what it holds once, by what its least value makes slip, and then no more.

Rings are as wide as the stiffness of one, w, and ``low`` to ``high`` of them in units of that. Each has an inner and an outer part. When a
contact grows again, the place where it had shrunk to becomes the border of both, so that the same area leaves the next time. Where the
contact is too large for ``MOST_RINGS``, two become one of 2 w with them as its parts; where it is too small, one becomes two.

Spin about the normal takes part by one ellipsoid with both displacements. A ring's stiffness about the normal goes as y³, so that alone
it turns by M = M₀ (1 − (1 − θ/θ₀)^(5/2)), θ₀ = 5 M₀ / (2 k).
``ShearState`` keeps the rings, ``shear_kernels`` moves them.
"""

from __future__ import annotations

MOST_RINGS = 48
"""Rings of a contact at most, all of one shear stiffness but the outermost."""
LEAST_RINGS = 18
"""And at least: three quarters of what the most are when two become one."""
