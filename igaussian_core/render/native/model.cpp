#include "model.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <new>
#include <utility>
#include <vector>

namespace igaussian {
namespace {

constexpr float kHalfMax = 65504.0f;

template <class T>
T* allocate(size_t count) {
  const size_t bytes = count * sizeof(T);
  void* p = allocate_bytes(bytes);
  if (!p) throw std::bad_alloc();
  std::memset(p, 0, bytes);
  return static_cast<T*>(p);
}

// IEEE 754 binary16, rounded to nearest even.
uint16_t to_half(float x) {
  uint32_t f;
  std::memcpy(&f, &x, 4);
  const uint32_t sign = (f >> 16) & 0x8000u;
  f &= 0x7fffffffu;
  if (f >= 0x47800000u) return static_cast<uint16_t>(sign | 0x7c00u);  // callers clamp before
  if (f < 0x38800000u) {  // subnormal: let the float unit round at 2^-24
    float a;
    std::memcpy(&a, &f, 4);
    a += 0.5f;
    uint32_t bits;
    std::memcpy(&bits, &a, 4);
    return static_cast<uint16_t>(sign | (bits - 0x3f000000u));
  }
  f += 0xc8000fffu + ((f >> 13) & 1u);
  return static_cast<uint16_t>(sign | (f >> 13));
}

// 21 bits spread to every third bit.
uint64_t spread(uint64_t x) {
  x = (x | x << 32) & 0x001f00000000ffffull;
  x = (x | x << 16) & 0x001f0000ff0000ffull;
  x = (x | x << 8) & 0x100f00f00f00f00full;
  x = (x | x << 4) & 0x10c30c30c30c30c3ull;
  return (x | x << 2) & 0x1249249249249249ull;
}

// Gaussians of a neighbourhood side by side: they are seen, or not, together.
std::vector<std::pair<uint64_t, int32_t>> morton_order(const Gaussians& g) {
  float low[3] = {HUGE_VALF, HUGE_VALF, HUGE_VALF}, high[3] = {-HUGE_VALF, -HUGE_VALF, -HUGE_VALF};
  for (int64_t i = 0; i < g.count * 3; ++i) {
    if (!std::isfinite(g.means[i])) continue;
    low[i % 3] = std::min(low[i % 3], g.means[i]);
    high[i % 3] = std::max(high[i % 3], g.means[i]);
  }
  double extent = 0;
  for (int k = 0; k < 3; ++k) extent = std::max(extent, double(high[k]) - double(low[k]));
  const double scale = extent > 0 ? ((1 << 21) - 1) / extent : 0;
  std::vector<std::pair<uint64_t, int32_t>> order(static_cast<size_t>(g.count));
  for (int64_t i = 0; i < g.count; ++i) {
    uint64_t code = 0;
    for (int k = 0; k < 3; ++k) {
      const double cell = (double(g.means[i * 3 + k]) - low[k]) * scale;
      const uint64_t number = cell > 0 ? static_cast<uint64_t>(std::min(cell, 2097151.0)) : 0;
      code |= spread(number) << k;
    }
    order[static_cast<size_t>(i)] = {code, static_cast<int32_t>(i)};
  }
  std::sort(order.begin(), order.end());
  return order;
}

// rotation(q) * diag(scales), row-major.
void covariance_factor(const float* q, const float* scales, float* out) {
  double w = q[0], x = q[1], y = q[2], z = q[3];
  const double norm = std::sqrt(w * w + x * x + y * y + z * z);
  if (!(norm > 0)) {
    w = 1;
    x = y = z = 0;
  } else {
    w /= norm, x /= norm, y /= norm, z /= norm;
  }
  const double R[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                       2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                       2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
  for (int i = 0; i < 9; ++i) out[i] = static_cast<float>(R[i] * scales[i % 3]);
}

void pack_one(const Gaussians& g, int32_t i, int64_t slot, Model* m) {
  const int64_t block = slot / kBlock, lane = slot % kBlock;
  m->index[slot] = i;
  m->log_opacity[slot] = std::log2(g.opacities[i]);
  for (int k = 0; k < 3; ++k) m->mean[(block * 3 + k) * kBlock + lane] = g.means[i * 3 + k];
  float factor[9];
  covariance_factor(g.quats_wxyz + int64_t(i) * 4, g.scales + int64_t(i) * 3, factor);
  for (int k = 0; k < 9; ++k) m->factor[(block * 9 + k) * kBlock + lane] = factor[k];
  const int values = 3 * g.sh_count;
  for (int k = 0; k < values; ++k) {
    const float value =
        std::max(-kHalfMax, std::min(kHalfMax, g.sh[int64_t(i) * values + k]));
    const int64_t at = (block * values + k) * kBlock + lane;
    if (m->half_sh) {
      static_cast<uint16_t*>(m->sh)[at] = to_half(value);
    } else {
      static_cast<float*>(m->sh)[at] = value;
    }
  }
}

Box bounding_box(const Model& m, int64_t super_block) {
  Box box;
  std::fill(box.low, box.low + 3, HUGE_VALF);
  std::fill(box.high, box.high + 3, -HUGE_VALF);
  box.radius = 0;
  for (int64_t slot = super_block * kSuperBlock; slot < (super_block + 1) * kSuperBlock; ++slot) {
    if (!(m.log_opacity[slot] >= kLog2AlphaMin)) continue;
    const int64_t block = slot / kBlock, lane = slot % kBlock;
    float square = 0;  // of the largest semi-axis: at most the sum of all
    float column[3] = {0, 0, 0};
    for (int k = 0; k < 9; ++k) {
      const float f = m.factor[(block * 9 + k) * kBlock + lane];
      column[k % 3] += f * f;
    }
    square = std::max(column[0], std::max(column[1], column[2]));
    const float reach = 2 * 0.6931472f * (m.log_opacity[slot] - kLog2AlphaMin);
    const float radius = std::sqrt(reach * square);
    float p[3];
    for (int k = 0; k < 3; ++k) p[k] = m.mean[(block * 3 + k) * kBlock + lane];
    if (!std::isfinite(p[0] + p[1] + p[2] + radius)) continue;  // never drawn
    box.radius = std::max(box.radius, radius);
    for (int k = 0; k < 3; ++k) {
      box.low[k] = std::min(box.low[k], p[k]);
      box.high[k] = std::max(box.high[k], p[k]);
    }
  }
  return box;
}

}  // namespace

Model* pack_model(const Gaussians& g, bool antialiased, bool half_sh) try {
  Model* m = new Model{};
  try {
    m->count = g.count;
    m->super_blocks = (g.count + kSuperBlock - 1) / kSuperBlock;
    m->degree = g.sh_count == 1 ? 0 : g.sh_count == 4 ? 1 : g.sh_count == 9 ? 2 : 3;
    m->antialiased = antialiased;
    m->half_sh = half_sh;
    const size_t slots = static_cast<size_t>(m->super_blocks) * kSuperBlock;
    m->mean = allocate<float>(slots * 3);
    m->factor = allocate<float>(slots * 9);
    m->log_opacity = allocate<float>(slots);
    m->index = allocate<int32_t>(slots);
    const size_t values = slots * 3 * static_cast<size_t>(g.sh_count);
    m->sh = half_sh ? static_cast<void*>(allocate<uint16_t>(values)) : allocate<float>(values);
    m->boxes = allocate<Box>(static_cast<size_t>(m->super_blocks));
    std::fill(m->log_opacity, m->log_opacity + slots, -std::numeric_limits<float>::infinity());
    const auto order = morton_order(g);
    for (size_t slot = 0; slot < order.size(); ++slot) {
      pack_one(g, order[slot].second, static_cast<int64_t>(slot), m);
    }
    for (int64_t s = 0; s < m->super_blocks; ++s) m->boxes[s] = bounding_box(*m, s);
    return m;
  } catch (...) {
    free_model(m);
    throw;
  }
} catch (const std::bad_alloc&) {
  return nullptr;
}

void free_model(Model* m) {
  if (!m) return;
  std::free(m->mean);
  std::free(m->factor);
  std::free(m->log_opacity);
  std::free(m->index);
  std::free(m->sh);
  std::free(m->boxes);
  delete m;
}

}  // namespace igaussian
