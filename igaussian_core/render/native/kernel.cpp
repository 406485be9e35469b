// Projection and blending, compiled once per instruction set.
// IGAUSSIAN_KERNEL names the resulting table of functions. No template of the standard library
// here, see scene.h.
#include <cmath>
#include <cstring>

#include "scene.h"
#include "simd.h"

namespace igaussian {
namespace {

// ---------------------------------------------------------------- projection

inline F coefficient(const Model& model, size_t at) {
  if (kHalfSh) return load_half(static_cast<const uint16_t*>(model.sh) + at);
  return load(static_cast<const float*>(model.sh) + at);
}

// Real spherical harmonics of unit direction (x, y, z), with the signs of 3D Gaussian Splatting.
template <int kDegree>
inline void harmonics(F x, F y, F z, F* basis) {
  basis[0] = splat(0.28209479177387814f);
  if (kDegree < 1) return;
  const F c1 = splat(0.4886025119029199f);
  basis[1] = -c1 * y;
  basis[2] = c1 * z;
  basis[3] = -c1 * x;
  if (kDegree < 2) return;
  const F xx = x * x, yy = y * y, zz = z * z;
  basis[4] = splat(1.0925484305920792f) * (x * y);
  basis[5] = splat(-1.0925484305920792f) * (y * z);
  basis[6] = splat(0.31539156525252005f) * (zz + zz - xx - yy);
  basis[7] = splat(-1.0925484305920792f) * (x * z);
  basis[8] = splat(0.5462742152960396f) * (xx - yy);
  if (kDegree < 3) return;
  const F three = splat(3.0f), four_zz = splat(4.0f) * zz;
  basis[9] = splat(-0.5900435899266435f) * y * (three * xx - yy);
  basis[10] = splat(2.890611442640554f) * (x * y) * z;
  basis[11] = splat(-0.4570457994644658f) * y * (four_zz - xx - yy);
  basis[12] = splat(0.3731763325901154f) * z * (zz + zz - three * (xx + yy));
  basis[13] = splat(-0.4570457994644658f) * x * (four_zz - xx - yy);
  basis[14] = splat(1.445305721320277f) * z * (xx - yy);
  basis[15] = splat(-0.5900435899266435f) * x * (xx - three * yy);
}

template <int kDegree>
inline void colour(const Model& model, size_t at, F x, F y, F z, F* rgb) {
  constexpr int kCount = (kDegree + 1) * (kDegree + 1);
  F basis[kCount];
  harmonics<kDegree>(x, y, z, basis);
  F r = splat(0.5f), g = r, b = r;
  for (int k = 0; k < kCount; ++k, at += 3 * kBlock) {
    r = r + basis[k] * coefficient(model, at);
    g = g + basis[k] * coefficient(model, at + kBlock);
    b = b + basis[k] * coefficient(model, at + 2 * kBlock);
  }
  const F zero = splat(0.0f);
  rgb[0] = larger(r, zero);
  rgb[1] = larger(g, zero);
  rgb[2] = larger(b, zero);
}

inline void colour_of_degree(const Model& model, size_t at, F x, F y, F z, F* rgb) {
  switch (model.degree) {
    case 0: return colour<0>(model, at, x, y, z, rgb);
    case 1: return colour<1>(model, at, x, y, z, rgb);
    case 2: return colour<2>(model, at, x, y, z, rgb);
    default: return colour<3>(model, at, x, y, z, rgb);
  }
}

inline void file(Bins* bins, int tile, uint64_t key) {
  TileList& list = bins->tiles[tile];
  Chunk* chunk = list.tail;
  if (__builtin_expect(chunk == nullptr || chunk->size == Chunk::kKeys, 0)) {
    Chunk* fresh = take_chunk(&bins->arena);
    if (fresh == nullptr) {
      bins->out_of_memory = true;
      return;
    }
    (chunk ? chunk->next : list.head) = fresh;
    list.tail = chunk = fresh;
  }
  chunk->keys[chunk->size++] = key;
}

// W projected Gaussians, one vector for each member of Splat from u to dy_right.
struct Projected {
  static constexpr int kFields = 14;
  alignas(64) float field[kFields][W];
  int32_t x0[W], x1[W], y0[W], y1[W];  // tiles touched, inclusive
  unsigned visible;
};

inline void project_lanes(const Model& model, const View& view, const Bins& bins, size_t block,
                          int lane, Projected* out) {
  const float* mean = model.mean + block * 3 * kBlock + lane;
  const F X = load(mean), Y = load(mean + kBlock), Z = load(mean + 2 * kBlock);
  const float* R = view.R;
  const F z = splat(R[6]) * X + splat(R[7]) * Y + splat(R[8]) * Z + splat(view.t[2]);
  const F log_opacity = load(model.log_opacity + block * kBlock + lane);
  M visible = both(above(z, splat(view.near_plane)),
                   at_least(log_opacity, splat(kLog2AlphaMin)));
  out->visible = bits(visible);
  if (!out->visible) return;

  const F x = splat(R[0]) * X + splat(R[1]) * Y + splat(R[2]) * Z + splat(view.t[0]);
  const F y = splat(R[3]) * X + splat(R[4]) * Y + splat(R[5]) * Z + splat(view.t[1]);
  const F inv_z = splat(1.0f) / z;
  const F nx = x * inv_z, ny = y * inv_z;
  const F u = splat(view.fx) * nx + splat(view.cx), v = splat(view.fy) * ny + splat(view.cy);

  // rows of J R, J the Jacobian of the projection with x/z and y/z clamped
  const F lx = smaller(larger(nx, splat(view.x_limit[0])), splat(view.x_limit[1]));
  const F ly = smaller(larger(ny, splat(view.y_limit[0])), splat(view.y_limit[1]));
  const F gx = splat(view.fx) * inv_z, gy = splat(view.fy) * inv_z;
  F p[3], q[3];
  for (int k = 0; k < 3; ++k) {
    p[k] = gx * (splat(R[k]) - lx * splat(R[6 + k]));
    q[k] = gy * (splat(R[3 + k]) - ly * splat(R[6 + k]));
  }
  // times the factor L of the covariance L L^T
  const float* factor = model.factor + block * 9 * kBlock + lane;
  F m[3], n[3];
  for (int k = 0; k < 3; ++k) {
    const F l0 = load(factor + k * kBlock), l1 = load(factor + (3 + k) * kBlock),
            l2 = load(factor + (6 + k) * kBlock);
    m[k] = p[0] * l0 + p[1] * l1 + p[2] * l2;
    n[k] = q[0] * l0 + q[1] * l1 + q[2] * l2;
  }
  const F sxx = m[0] * m[0] + m[1] * m[1] + m[2] * m[2];
  const F sxy = m[0] * n[0] + m[1] * n[1] + m[2] * n[2];
  const F syy = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
  // the determinant from a cross product: sxx syy - sxy^2 would cancel for needles
  const F c0 = m[1] * n[2] - m[2] * n[1], c1 = m[2] * n[0] - m[0] * n[2],
          c2 = m[0] * n[1] - m[1] * n[0];
  const F det_sharp = c0 * c0 + c1 * c1 + c2 * c2;
  const F low_pass = splat(kLowPass);
  const F det = det_sharp + low_pass * (sxx + syy) + low_pass * low_pass;
  const F cxx = sxx + low_pass, cyy = syy + low_pass;

  F lo = log_opacity;
  if (model.antialiased) {
    const F ratio = larger(det_sharp / det, splat(1e-30f));
    lo = lo + splat(0.5f) * log2_near(ratio);
  }
  const F reach = splat(2.0f * 0.6931471805599453f) * (lo - splat(kLog2AlphaMin));
  visible = both(visible, at_least(reach, splat(0.0f)));
  const F hx = root(reach * cxx), hy = root(reach * cyy);
  const F width = splat(static_cast<float>(view.width - 1));
  const F height = splat(static_cast<float>(view.height - 1));
  const F zero = splat(0.0f), huge = splat(1e9f);
  const F left = u - hx, right = u + hx, top = v - hy, bottom = v + hy;
  visible = both(visible, both(at_least(right, zero), at_least(width, left)));
  visible = both(visible, both(at_least(bottom, zero), at_least(height, top)));
  visible = both(visible, both(above(huge, hx), above(huge, hy)));
  out->visible = bits(visible);
  if (!out->visible) return;

  const F inv_det = splat(1.0f) / det;
  const F log2e = splat(1.4426950408889634f), half = splat(0.5f);
  const F a = -half * log2e * cyy * inv_det, c = -half * log2e * cxx * inv_det;
  const F b = log2e * sxy * inv_det;

  const F dx = X - splat(view.centre[0]), dy = Y - splat(view.centre[1]),
          dz = Z - splat(view.centre[2]);
  const F inv_distance = splat(1.0f) / root(dx * dx + dy * dy + dz * dz);
  const int sh_count = (model.degree + 1) * (model.degree + 1);
  F rgb[3];
  colour_of_degree(model, block * 3 * kBlock * sh_count + lane, dx * inv_distance,
                   dy * inv_distance, dz * inv_distance, rgb);

  const F slope = sxy / cyy;
  const F root2 = -det / (cyy * cyy), root0 = reach * det / cyy;
  const F fields[Projected::kFields] = {u,      v,      a,      b, c,     lo,    rgb[0],
                                        rgb[1], rgb[2], z,      slope, root0, root2,
                                        sxy / cxx * hx};
  for (int k = 0; k < Projected::kFields; ++k) store(out->field[k], fields[k]);
  const F per_tile = splat(1.0f / kTile);
  store_int(out->x0, larger(left, zero) * per_tile);
  store_int(out->y0, larger(top, zero) * per_tile);
  store_int(out->x1, smaller(right * per_tile, splat(static_cast<float>(bins.tiles_x - 1))));
  store_int(out->y1, smaller(bottom * per_tile, splat(static_cast<float>(bins.tiles_y - 1))));
}

void project(const Model& model, const View& view, int64_t super_block, Splat* splats,
             uint32_t first_splat, Bins* bins) {
  constexpr int kBlocks = kSuperBlock / kBlock;
  Projected lanes;
  int count = 0;
  for (int i = 0; i < kBlocks; ++i) {
    const size_t block = static_cast<size_t>(super_block) * kBlocks + i;
    for (int lane = 0; lane < kBlock; lane += W) {
      project_lanes(model, view, *bins, block, lane, &lanes);
      for (unsigned m = lanes.visible; m; m &= m - 1) {
        const int l = __builtin_ctz(m);
        Splat* s = splats + count;
        float* fields = &s->u;
        for (int k = 0; k < Projected::kFields; ++k) fields[k] = lanes.field[k][l];
        s->index = model.index[block * kBlock + lane + l];
        uint32_t depth;
        std::memcpy(&depth, &s->z, 4);
        const uint64_t key = static_cast<uint64_t>(depth) << 32 | (first_splat + count);
        ++count;
        for (int y = lanes.y0[l]; y <= lanes.y1[l]; ++y) {
          for (int x = lanes.x0[l]; x <= lanes.x1[l]; ++x) {
            file(bins, y * bins->tiles_x + x, key);
          }
        }
      }
    }
  }
  bins->visible += count;
}

// ---------------------------------------------------------------- blending

// Bit 8 * row + column of each cell of the tile that the ellipse alpha >= 1/255 meets.
// (x, y): the Gaussian's centre from the tile's first pixel centre.
inline uint64_t cells_touched(const Splat& s, float x, float y) {
  constexpr float kSlack = 0.01f;  // rounding may add a cell, never lose a pixel
  int32_t row_bits[8];
  for (int row = 0; row < 8; ++row) {
    const float low = row * float(kCell) - y, high = low + (kCell - 1);
    float at_right = s.dy_right > low ? s.dy_right : low;
    at_right = at_right < high ? at_right : high;
    float at_left = -s.dy_right > low ? -s.dy_right : low;
    at_left = at_left < high ? at_left : high;
    const float square_right = s.root0 + s.root2 * at_right * at_right;
    const float square_left = s.root0 + s.root2 * at_left * at_left;
    const float safe_right = square_right > 0 ? square_right : 0;
    const float safe_left = square_left > 0 ? square_left : 0;
    float first = x + s.slope * at_left - std::sqrt(safe_left) - kSlack;
    float last = x + s.slope * at_right + std::sqrt(safe_right) + kSlack;
    // [first, last] in pixels to cells [begin, end); +3 rounds up to the next pixel centre's cell
    first = first > 0 ? first : 0;
    first = first < kTile ? first : kTile;
    last = last > -1 ? last : -1;
    last = last < kTile - 1 ? last : kTile - 1;
    const int32_t floor_first = static_cast<int32_t>(first);
    const int32_t first_pixel = floor_first + (static_cast<float>(floor_first) < first);
    const int32_t begin = first_pixel >> 2;
    const int32_t end = (static_cast<int32_t>(last + 4.0f) >> 2);
    const bool meets = (square_right >= 0) | (square_left >= 0);
    row_bits[row] = (meets & (end > begin)) ? (1 << end) - (1 << begin) : 0;
  }
  uint64_t cells = 0;
  for (int row = 0; row < 8; ++row) {
    cells |= static_cast<uint64_t>(static_cast<uint32_t>(row_bits[row]) & 255u) << (8 * row);
  }
  return cells;
}

// Planes of one cell in the tile's frame buffer, each of 16 pixels.
enum Plane { kT, kAlpha, kRed, kGreen, kBlue, kDepth, kMedian, kWeight, kId, kPlanes };

struct alignas(64) TileBuffer {
  float cell[kCells][kPlanes][kPixels];
};

// Offsets of the pixels of a cell, and of the cells of a tile.
struct alignas(64) Offsets {
  float pixel_x[kPixels], pixel_y[kPixels];
};
const Offsets kOffsets = {{0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3},
                          {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3}};

// One Gaussian over W pixels of one cell.
template <bool kExtra>
inline void blend_lanes(const Splat& s, F dx, F dy, float* cell) {
  const F q = dx * (splat(s.a) * dx + splat(s.b) * dy) +
              (splat(s.c) * dy * dy + splat(s.log_opacity));
  const M counts = at_least(q, splat(kLog2AlphaMin));
  const F alpha = smaller(exp2_near(q), splat(kAlphaMax));
  const F before = load(cell + kT * kPixels);
  F weight = keep(counts, alpha * before);
  const F after = before - weight;
  store(cell + kT * kPixels, after);
  // the Gaussian that would push the transmittance under kStop is dropped, and so is all behind
  // it: after never grows again
  weight = keep(at_least(after, splat(kStop)), weight);
  const auto add = [&](int plane, F x) {
    float* p = cell + plane * kPixels;
    store(p, load(p) + x);
  };
  add(kAlpha, weight);
  add(kRed, weight * splat(s.red));
  add(kGreen, weight * splat(s.green));
  add(kBlue, weight * splat(s.blue));
  add(kDepth, weight * splat(s.z));
  if (kExtra) {
    const F half = splat(0.5f), alpha_sum = load(cell + kAlpha * kPixels);
    const M crossed = both(at_least(alpha_sum, half), above(half, alpha_sum - weight));
    float* p = cell + kMedian * kPixels;
    store(p, pick(crossed, splat(s.z), load(p)));
    p = cell + kWeight * kPixels;
    const M heavier = above(weight, load(p));
    store(p, pick(heavier, weight, load(p)));
    p = cell + kId * kPixels;
    float index;
    std::memcpy(&index, &s.index, 4);
    store(p, pick(heavier, splat(index), load(p)));
  }
}

// Bits of the cells that have pixels inside the image.
inline uint64_t cells_inside(int width, int height) {
  const int columns = width >= kTile ? 8 : (width + kCell - 1) / kCell;
  const int rows = height >= kTile ? 8 : (height + kCell - 1) / kCell;
  uint64_t cells = 0;
  for (int row = 0; row < rows; ++row) cells |= ((1ull << columns) - 1) << (8 * row);
  return cells;
}

// Bits of the cells, among those given, where some pixel is not finished.
inline uint64_t unfinished(const TileBuffer& buffer, uint64_t cells) {
  uint64_t live = 0;
  for (uint64_t m = cells; m; m &= m - 1) {
    const int cell = __builtin_ctzll(m);
    unsigned any = 0;
    for (int l = 0; l < kPixels; l += W) {
      any |= bits(at_least(load(&buffer.cell[cell][kT][l]), splat(kStop)));
    }
    live |= static_cast<uint64_t>(any != 0) << cell;
  }
  return live;
}

template <bool kExtra>
int64_t blend_keys(const Splat* splats, const uint64_t* keys, int64_t n, float tile_u,
                   float tile_v, uint64_t live, TileBuffer* buffer) {
  constexpr int kBatch = 32;
  uint64_t cells[kBatch];
  int64_t evaluated = 0;
  for (int64_t start = 0; start < n && live; start += kBatch) {
    const int size = static_cast<int>(n - start < kBatch ? n - start : kBatch);
    for (int i = 0; i < size; ++i) {
      if (start + i + 16 < n) {
        __builtin_prefetch(&splats[static_cast<uint32_t>(keys[start + i + 16])]);
      }
      const Splat& s = splats[static_cast<uint32_t>(keys[start + i])];
      cells[i] = cells_touched(s, s.u - tile_u, s.v - tile_v) & live;
    }
    for (int i = 0; i < size; ++i) {
      const Splat& s = splats[static_cast<uint32_t>(keys[start + i])];
      const float u = tile_u - s.u, v = tile_v - s.v;
      evaluated += __builtin_popcountll(cells[i]);
      for (uint64_t m = cells[i]; m; m &= m - 1) {
        const int cell = __builtin_ctzll(m);
        const F x = splat(u + kCell * (cell & 7)), y = splat(v + kCell * (cell >> 3));
        for (int l = 0; l < kPixels; l += W) {
          blend_lanes<kExtra>(s, x + load(kOffsets.pixel_x + l), y + load(kOffsets.pixel_y + l),
                              &buffer->cell[cell][0][l]);
        }
      }
    }
    live = unfinished(*buffer, live);
  }
  return evaluated;
}

void clear(TileBuffer* buffer, bool extra) {
  for (int cell = 0; cell < kCells; ++cell) {
    float* p = buffer->cell[cell][0];
    for (int l = 0; l < kPixels; ++l) p[l] = 1.0f;
    std::memset(p + kPixels, 0, (kMedian - 1) * kPixels * sizeof(float));
    if (!extra) continue;
    std::memset(p + kMedian * kPixels, 0, 2 * kPixels * sizeof(float));
    std::memset(p + kId * kPixels, 0xff, kPixels * sizeof(float));  // -1
  }
}

void write_pixels(const View& view, const TileBuffer& buffer, int x0, int y0,
                  const Images& images) {
  const int width = view.width - x0 < kTile ? view.width - x0 : kTile;
  const int height = view.height - y0 < kTile ? view.height - y0 : kTile;
  for (int y = 0; y < height; ++y) {
    const size_t row = static_cast<size_t>(y0 + y) * view.width + x0;
    for (int x = 0; x < width; ++x) {
      const auto& cell = buffer.cell[(y / kCell) * 8 + x / kCell];
      const int l = (y % kCell) * kCell + x % kCell;
      const float alpha = cell[kAlpha][l];
      if (images.rgb) {
        float* rgb = images.rgb + (row + x) * 3;
        rgb[0] = cell[kRed][l] + (1 - alpha) * images.background[0];
        rgb[1] = cell[kGreen][l] + (1 - alpha) * images.background[1];
        rgb[2] = cell[kBlue][l] + (1 - alpha) * images.background[2];
      }
      if (images.depth) images.depth[row + x] = alpha > 0 ? cell[kDepth][l] / alpha : 0;
      if (images.alpha) images.alpha[row + x] = alpha;
      if (images.median_depth) images.median_depth[row + x] = cell[kMedian][l];
      if (images.ids) std::memcpy(&images.ids[row + x], &cell[kId][l], 4);
    }
  }
}

int64_t blend(const View& view, const Splat* splats, const uint64_t* keys, int64_t n, int tile_x,
              int tile_y, const Images& images) {
  TileBuffer buffer;
  const int x0 = tile_x * kTile, y0 = tile_y * kTile;
  const bool extra = images.median_depth || images.ids;
  clear(&buffer, extra);
  const uint64_t live = cells_inside(view.width - x0, view.height - y0);
  const float u = static_cast<float>(x0), v = static_cast<float>(y0);
  const int64_t evaluated = extra ? blend_keys<true>(splats, keys, n, u, v, live, &buffer)
                                  : blend_keys<false>(splats, keys, n, u, v, live, &buffer);
  write_pixels(view, buffer, x0, y0, images);
  return evaluated;
}

}  // namespace

extern const Kernel IGAUSSIAN_KERNEL;
const Kernel IGAUSSIAN_KERNEL = {IGAUSSIAN_KERNEL_NAME, kHalfSh, project, blend};

}  // namespace igaussian
