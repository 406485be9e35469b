"""Rendering of 3D Gaussians on a CPU: a native kernel, and the slow torch reference it is tested
against (`igaussian_core.render.reference`).
"""

from __future__ import annotations

from igaussian_core.render.rasterizer import (
    Rasterizer,
    Render,
    RenderGradients,
    RenderStats,
    available_simd,
)

__all__ = ["Rasterizer", "Render", "RenderGradients", "RenderStats", "available_simd"]
