#pragma once
#include "model.h"

namespace igaussian {

// What a backward pass reads and fills; Python mirrors this struct field by field.
struct Gradients {
  // of the loss by the images, null where it does not depend on one
  const float *rgb, *depth, *alpha;
  // of the loss by the caller's arrays, same shapes, zeroed by the caller
  float *means, *quats_wxyz, *scales, *opacities, *sh;
  double T_cam_scene[16];  // row-major; the last row stays 0
};

// Carries the gradient by one projected Gaussian on to its parameters and to the camera.
// T is double[12], rows of [R | t], added to.
void chain_rule(const Gaussians&, const View&, bool antialiased, int32_t index,
                const SplatGradient&, const Gradients& out, double* T);

}  // namespace igaussian
