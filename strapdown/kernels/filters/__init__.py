"""Filters beside the MEKF: each module defines what :mod:`strapdown.kernels.filters.extended` leaves open, and is all of its filter."""
