#pragma once
#include "scene.h"

namespace igaussian {

// Arrays as the caller holds them, row-major float32.
struct Gaussians {
  int64_t count;
  int sh_count;             // 1, 4, 9 or 16
  const float* means;       // [N, 3]
  const float* quats_wxyz;  // [N, 4], any length
  const float* scales;      // [N, 3]
  const float* opacities;   // [N]
  const float* sh;          // [N, K, 3]
};

// Packs in Morton order, blocks of 16 side by side. Null when memory has run out.
Model* pack_model(const Gaussians&, bool antialiased, bool half_sh);
void free_model(Model*);

}  // namespace igaussian
