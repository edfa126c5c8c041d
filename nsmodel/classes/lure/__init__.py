"""Lur'e systems x' = A(x) + B l + f(t), y = C x + D l + e(t), with a law or a potential."""
