#pragma once
#include "gradient.h"

namespace igaussian {

constexpr int kMaxThreads = 64;

// What the caller asks of one frame; Python mirrors this struct field by field.
struct Frame {
  int32_t width, height, threads;
  float fx, fy, cx, cy, near_plane;
  double T_cam_scene[16];  // row-major
  float background[3];
  // outputs, row-major, null where not wanted
  float *rgb, *depth, *alpha, *median_depth;
  int32_t* ids;
  // filled in: nanoseconds summed over threads (projection and binning, sorting, blending),
  // then visible Gaussians, tile entries, cells evaluated
  int64_t nanoseconds[3];
  int64_t visible, entries, cells;
};

class Renderer;

enum Status { kOk = 0, kOutOfMemory = 1 };

}  // namespace igaussian
