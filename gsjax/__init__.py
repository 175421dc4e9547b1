"""gsjax: moving scenes from 3D Gaussians, in pure JAX."""
