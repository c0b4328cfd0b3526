"""Other filters than the MEKF: each module is one filter and defines the open functions of :mod:`strapdown.kernels.filters.extended`."""
