"""The demo room: an analytic indoor scene, its Gaussian map and a recorded drive through it."""
