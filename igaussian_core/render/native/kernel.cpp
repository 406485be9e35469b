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
  if (__builtin_expect(list.used == Chunk::kKeys, 0)) {
    Chunk* fresh = take_chunk(&bins->arena);
    if (fresh == nullptr) {
      bins->out_of_memory = true;
      return;
    }
    (list.tail ? list.tail->next : list.head) = fresh;
    list.tail = fresh;
    list.used = 0;
  }
  list.tail->keys[list.used++] = key;
}

// W projected Gaussians.
struct alignas(64) Projected {
  float lines[W][16];                  // Splats, but for the index
  double depth[W];
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

  const F dx = X - splat(view.centre[0]), dy = Y - splat(view.centre[1]),
          dz = Z - splat(view.centre[2]);
  const F inv_distance = splat(1.0f) / root(dx * dx + dy * dy + dz * dz);
  const int sh_count = (model.degree + 1) * (model.degree + 1);
  F rgb[3];
  colour_of_degree(model, block * 3 * kBlock * sh_count + lane, dx * inv_distance,
                   dy * inv_distance, dz * inv_distance, rgb);

  const F inv_cyy = splat(1.0f) / cyy;
  const F half_log2e = splat(0.5f * 1.4426950408889634f * kLogUnit);
  const F inv_along = root(det * inv_cyy / half_log2e), along = splat(1.0f) / inv_along;
  const F slope = sxy * inv_cyy;
  const F fields[16] = {u,
                        v,
                        along,
                        -along * slope,
                        root(half_log2e * inv_cyy),
                        (lo - splat(kLog2AlphaMin)) * splat(kLogUnit),
                        rgb[0],
                        rgb[1],
                        rgb[2],
                        z,
                        slope,
                        sxy * hx / cxx,
                        inv_along,
                        zero,
                        zero,
                        zero};
  to_lines(fields, out->lines[0]);
  for (int l = 0; l < W; ++l) {
    out->depth[l] = view.forward[0] * mean[l] + view.forward[1] * mean[kBlock + l] +
                    (view.forward[2] * mean[2 * kBlock + l] + view.forward[3]);
  }
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
        std::memcpy(static_cast<void*>(s), lanes.lines[l], sizeof(Splat));
        s->index = model.index[block * kBlock + lane + l];
        const uint64_t key = make_key(lanes.depth[l], first_splat + count);
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

constexpr int kBatch = 2048;

// The next Gaussians of one tile, front to back, and the cells of the tile that each touches.
struct alignas(64) Batch {
  Splat splats[kBatch + 1];   // the last is invisible: lists are filled up with it
  uint32_t cells[2][kBatch];  // bit 8 * row + column: rows 0 to 3, rows 4 to 7
  uint32_t row[kBatch + 16];  // those that touch one row of cells: number, columns << 16
  uint32_t list[kBatch + 16]; // those that touch one cell: number
};

// Cells that the ellipses alpha >= 1/255 of Gaussians i ... i + W - 1 meet. Over a row of cells
// the ellipse reaches farthest right at dy_right, clamped to the row's pixel centres, farthest
// left at -dy_right.
inline void cells_touched(Batch* batch, int i, float tile_u, float tile_v) {
  static constexpr int kFields[] = {0, 1, 4, 5, 10, 11, 12};
  F fields[7];
  from_lines(&batch->splats[i].u, kFields, fields);
  const F u = fields[0] - splat(tile_u), v = fields[1] - splat(tile_v);
  const F curve = fields[2] * fields[2], reach = fields[3];
  const F slope = fields[4], dy_right = fields[5], inv_along = fields[6];
  // rounding may add a cell, never lose a pixel
  const F slack = splat(0.01f), widened = inv_along * splat(1.0005f);
  const F zero = splat(0.0f), eight = splat(8.0f), quarter = splat(0.25f), tiny = splat(1e-12f);
  I words[2];
  for (int row = 0; row < 8; ++row) {
    const F low = splat(static_cast<float>(row * kCell)) - v, high = low + splat(kCell - 1.0f);
    const F right_y = smaller(larger(dy_right, low), high);
    const F left_y = smaller(larger(-dy_right, low), high);
    const F right_square = reach - curve * right_y * right_y;
    const F left_square = reach - curve * left_y * left_y;
    const M meets = at_least(larger(right_square, left_square), zero);
    const F right =
        u + slope * right_y + (widened * rough_root(larger(right_square, tiny)) + slack);
    const F left =
        u + slope * left_y - (widened * rough_root(larger(left_square, tiny)) + slack);
    const F begin = smaller(larger((left + splat(1.0f)) * quarter, zero), eight);
    const F end = smaller(larger((right + splat(4.0f)) * quarter, zero), eight);
    // bits begin ... end - 1
    const F run = larger(power_of_floor(end) - power_of_floor(begin), zero);
    const I row_bits = to_int(keep(meets, run));
    I& word = words[row / 4];
    word = row % 4 ? or_shifted(word, row_bits, row % 4 * 8) : row_bits;
  }
  store_int(batch->cells[0] + i, words[0]);
  store_int(batch->cells[1] + i, words[1]);
}

// Fills batch->row, in order, with zeros behind; returns its size.
inline int list_row(Batch* batch, int count, int row) {
  int size = 0;
  for (int i = 0; i < count; i += W) {
    const I columns = byte_of(load_int(batch->cells[row / 4] + i), row % 4);
    const I numbered = or_shifted(counting_from(i), columns, 16);
    size = append(any_bit(columns), numbered, batch->row, size);
  }
  for (int i = 0; i < W; ++i) batch->row[size + i] = 0;
  return size;
}

// Fills batch->list, in order, with the invisible Gaussian behind; returns its size.
inline int list_cell(Batch* batch, int row_size, int column) {
  int size = 0;
  for (int i = 0; i < row_size; i += W) {
    const I numbered = load_int(batch->row + i);
    size = append(has_bit(numbered, 16 + column), low_half(numbered), batch->list, size);
  }
  for (int i = 0; i < kTogether; ++i) batch->list[size + i] = kBatch;
  return size;
}

// Planes of one cell in the tile's frame buffer, each of 16 pixels.
enum Plane { kT, kAlpha, kRed, kGreen, kBlue, kDepth, kMedian, kWeight, kId, kPlanes };

struct alignas(64) TileBuffer {
  float cell[kCells][kPlanes][kPixels];
};

struct alignas(64) Offsets {
  float x[kPixels], y[kPixels];
};
const Offsets kPixelOffsets = {{0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3},
                               {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3}};

// kVectors * W pixels of a cell, side by side, while Gaussians are blended into them: what they
// share, a Gaussian's numbers and the part of its ellipse along x, is fetched and computed once.
template <bool kExtra>
struct Accumulator {
  F x, y[kVectors];  // pixel centres; x is the same in each vector
  M open[kVectors];  // pixels that are not finished
  F t[kVectors], alpha[kVectors];  // of open pixels the transmittance, of finished ones alpha
  F red[kVectors], green[kVectors], blue[kVectors], depth[kVectors];
  F median[kVectors], heaviest[kVectors], id[kVectors];

  inline void read(const float* p) {
    for (int v = 0; v < kVectors; ++v, p += W) {
      t[v] = load(p + kT * kPixels);
      open[v] = at_least(t[v], splat(kStop));
      alpha[v] = load(p + kAlpha * kPixels);
      red[v] = load(p + kRed * kPixels);
      green[v] = load(p + kGreen * kPixels);
      blue[v] = load(p + kBlue * kPixels);
      depth[v] = load(p + kDepth * kPixels);
      if (!kExtra) continue;
      median[v] = load(p + kMedian * kPixels);
      heaviest[v] = load(p + kWeight * kPixels);
      id[v] = load(p + kId * kPixels);
    }
  }

  inline void write(float* p) const {
    for (int v = 0; v < kVectors; ++v, p += W) {
      store(p + kT * kPixels, t[v]);
      store(p + kAlpha * kPixels, pick(open[v], splat(1.0f) - t[v], alpha[v]));
      store(p + kRed * kPixels, red[v]);
      store(p + kGreen * kPixels, green[v]);
      store(p + kBlue * kPixels, blue[v]);
      store(p + kDepth * kPixels, depth[v]);
      if (!kExtra) continue;
      store(p + kMedian * kPixels, median[v]);
      store(p + kWeight * kPixels, heaviest[v]);
      store(p + kId * kPixels, id[v]);
    }
  }

  inline unsigned unfinished() const {
    unsigned some = 0;
    for (int v = 0; v < kVectors; ++v) some |= bits(open[v]);
    return some;
  }

  // alphas of kAbreast Gaussians, step by step: each step waits for the one before
  inline void alphas(const Splat* splats, const uint32_t* list, F (*a)[kVectors]) const {
    constexpr int kAll = kAbreast * kVectors;
    const Splat* s[kAbreast];
    F along_x[kAbreast], dy[kAll], p[kAll], q[kAll], power[kAll];
    for (int i = 0; i < kAbreast; ++i) s[i] = splats + list[i];
    for (int i = 0; i < kAbreast; ++i) along_x[i] = splat(s[i]->along) * (x - splat(s[i]->u));
    const auto each = [&](auto step) {
      for (int i = 0; i < kAbreast; ++i) {
        for (int v = 0; v < kVectors; ++v) step(i, v, i * kVectors + v);
      }
    };
    each([&](int i, int v, int n) { dy[n] = y[v] - splat(s[i]->v); });
    each([&](int i, int, int n) { q[n] = splat(s[i]->across) * dy[n]; });
    each([&](int i, int, int n) { p[n] = splat(s[i]->shear) * dy[n] + along_x[i]; });
    each([&](int i, int, int n) { power[n] = minus_product(splat(s[i]->reach), q[n], q[n]); });
    each([&](int, int, int n) { power[n] = minus_product(power[n], p[n], p[n]); });
    alphas_near<kAll>(power);
    each([&](int i, int v, int n) { a[i][v] = smaller_positive(power[n], splat(kAlphaMax)); });
  }

  // kTogether Gaussians, front to back
  inline void add(const Splat* splats, const uint32_t* list) {
    F a[kTogether][kVectors], weight[kTogether][kVectors], left[kTogether][kVectors];
    F before[kVectors];
    for (int i = 0; i < kTogether; i += kAbreast) alphas(splats, list + i, a + i);
    for (int v = 0; v < kVectors; ++v) before[v] = t[v];
    for (int i = 0; i < kTogether; ++i) {
      for (int v = 0; v < kVectors; ++v) {
        weight[i][v] = a[i][v] * t[v];
        left[i][v] = t[v] = minus_product(t[v], a[i][v], t[v]);
      }
    }
    unsigned finishing = 0;
    for (int v = 0; v < kVectors; ++v) {
      finishing |= bits(without(open[v], at_least(t[v], splat(kStop))));
    }
    if (__builtin_expect(finishing, 0)) finish_some(before, a, weight, left);
    for (int i = 0; i < kTogether; ++i) {
      const Splat& s = splats[list[i]];
      for (int v = 0; v < kVectors; ++v) {
        red[v] = red[v] + weight[i][v] * splat(s.red);
        green[v] = green[v] + weight[i][v] * splat(s.green);
        blue[v] = blue[v] + weight[i][v] * splat(s.blue);
        depth[v] = depth[v] + weight[i][v] * splat(s.z);
        if (kExtra) add_extra(s, v, weight[i][v], i ? left[i - 1][v] : before[v], left[i][v]);
      }
    }
  }

  // Blends again where a pixel finishes: the Gaussian that would push its transmittance under
  // kStop is dropped, and so is all behind it.
  inline void finish_some(const F* before, const F (*a)[kVectors], F (*weight)[kVectors],
                          F (*left)[kVectors]) {
    for (int v = 0; v < kVectors; ++v) {
      t[v] = before[v];
      M still = open[v];
      for (int i = 0; i < kTogether; ++i) {
        const F w = a[i][v] * t[v], next = minus_product(t[v], a[i][v], t[v]);
        still = both(still, at_least(next, splat(kStop)));
        weight[i][v] = keep(still, w);
        left[i][v] = t[v] = pick(still, next, t[v]);
      }
      alpha[v] = pick(without(open[v], still), splat(1.0f) - t[v], alpha[v]);
      t[v] = keep(still, t[v]);
      open[v] = still;
    }
  }

  inline void add_extra(const Splat& s, int v, F weight, F before, F after) {
    const F half = splat(0.5f);
    median[v] = pick(both(above(before, half), at_least(half, after)), splat(s.z), median[v]);
    const M heavier = above(weight, heaviest[v]);
    heaviest[v] = pick(heavier, weight, heaviest[v]);
    float index;
    std::memcpy(&index, &s.index, 4);
    id[v] = pick(heavier, splat(index), id[v]);
  }
};

// The batch's list over one cell. False where every pixel of the cell is finished.
template <bool kExtra>
inline bool blend_cell(const Batch& batch, int size, float cell_u, float cell_v, float* pixels) {
  unsigned unfinished = 0;
  for (int l = 0; l < kPixels; l += kVectors * W) {
    Accumulator<kExtra> sum;
    sum.x = splat(cell_u) + load(kPixelOffsets.x + l);
    for (int v = 0; v < kVectors; ++v) {
      sum.y[v] = splat(cell_v) + load(kPixelOffsets.y + l + v * W);
    }
    sum.read(pixels + l);
    for (int i = 0; i < size && sum.unfinished(); i += kTogether) {
      sum.add(batch.splats, batch.list + i);
    }
    sum.write(pixels + l);
    unfinished |= sum.unfinished();
  }
  return unfinished != 0;
}

// Bits of the cells that have pixels inside the image.
inline uint64_t cells_inside(int width, int height) {
  const int columns = width >= kTile ? 8 : (width + kCell - 1) / kCell;
  const int rows = height >= kTile ? 8 : (height + kCell - 1) / kCell;
  uint64_t cells = 0;
  for (int row = 0; row < rows; ++row) cells |= ((1ull << columns) - 1) << (8 * row);
  return cells;
}

// Copies the next Gaussians side by side and finds the cells that they touch; returns their
// number, rounded up to what list_row reads.
inline int stage(const Splat* splats, const uint64_t* keys, int64_t left, int size, float tile_u,
                 float tile_v, Batch* batch) {
  constexpr int kAhead = 48;
  const int padded = (size + 15) / 16 * 16;
  for (int i = 0; i < size; ++i) {
    if (i + kAhead < left) {
      __builtin_prefetch(&splats[splat_of(keys[i + kAhead])]);
    }
    batch->splats[i] = splats[splat_of(keys[i])];
  }
  for (int i = size; i < padded; ++i) batch->splats[i] = batch->splats[kBatch];
  for (int i = 0; i < padded; i += W) cells_touched(batch, i, tile_u, tile_v);
  return padded;
}

// Calls visit(row, column, size of batch->list) for the live cells that the batch touches;
// returns the cells of which visit says that they are finished.
template <class Visit>
inline uint64_t for_each_cell(Batch* batch, int padded, uint64_t live, Visit visit) {
  uint64_t finished = 0;
  for (int row = 0; row < 8; ++row) {
    unsigned columns = static_cast<unsigned>(live >> (8 * row)) & 255u;
    const int row_size = columns ? list_row(batch, padded, row) : 0;
    if (row_size == 0) continue;
    for (; columns; columns &= columns - 1) {
      const int column = __builtin_ctz(columns);
      const int size = list_cell(batch, row_size, column);
      if (size && !visit(row, column, size)) finished |= 1ull << (8 * row + column);
    }
  }
  return finished;
}

template <bool kExtra>
int64_t blend_keys(const Splat* splats, const uint64_t* keys, int64_t n, float tile_u,
                   float tile_v, uint64_t live, Batch* batch, TileBuffer* buffer) {
  int64_t evaluated = 0;
  for (int64_t start = 0; start < n && live; start += kBatch) {
    const int size = static_cast<int>(n - start < kBatch ? n - start : kBatch);
    const int padded = stage(splats, keys + start, n - start, size, tile_u, tile_v, batch);
    live &= ~for_each_cell(batch, padded, live, [&](int row, int column, int count) {
      evaluated += count;
      return blend_cell<kExtra>(*batch, count, tile_u + kCell * column, tile_v + kCell * row,
                                buffer->cell[8 * row + column][0]);
    });
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

// Background added and depth divided, in place.
inline void finish_cell(float* cell, const Images& images) {
  const F one = splat(1.0f), zero = splat(0.0f);
  for (int l = 0; l < kPixels; l += W) {
    const F alpha = load(cell + kAlpha * kPixels + l);
    for (int k = 0; k < 3; ++k) {
      float* p = cell + (kRed + k) * kPixels + l;
      store(p, load(p) + (one - alpha) * splat(images.background[k]));
    }
    float* depth = cell + kDepth * kPixels + l;
    const M drawn = above(alpha, zero);
    store(depth, keep(drawn, load(depth) / pick(drawn, alpha, one)));
  }
}

// Pixels [0, count) of one row of a cell, at the image's edge.
void write_some(const float* cell, size_t at, int count, const Images& images) {
  for (int x = 0; x < count; ++x) {
    for (int k = 0; k < 3 && images.rgb; ++k) {
      images.rgb[(at + x) * 3 + k] = cell[(kRed + k) * kPixels + x];
    }
    if (images.depth) images.depth[at + x] = cell[kDepth * kPixels + x];
    if (images.alpha) images.alpha[at + x] = cell[kAlpha * kPixels + x];
    if (images.median_depth) images.median_depth[at + x] = cell[kMedian * kPixels + x];
    if (images.ids) std::memcpy(images.ids + at + x, cell + kId * kPixels + x, sizeof(float));
  }
}

// A whole row of a cell.
template <bool kPastCache>
inline void write_row(const float* cell, size_t at, const Images& images) {
  if (images.rgb) {
    const F4 r = load4(cell + kRed * kPixels), g = load4(cell + kGreen * kPixels),
             b = load4(cell + kBlue * kPixels);
    float* rgb = images.rgb + at * 3;
    store4<kPastCache>(rgb, F4{r[0], g[0], b[0], r[1]});
    store4<kPastCache>(rgb + 4, F4{g[1], b[1], r[2], g[2]});
    store4<kPastCache>(rgb + 8, F4{b[2], r[3], g[3], b[3]});
  }
  const auto copy = [&](void* image, int plane) {
    if (image) store4<kPastCache>(static_cast<float*>(image) + at, load4(cell + plane * kPixels));
  };
  copy(images.depth, kDepth);
  copy(images.alpha, kAlpha);
  copy(images.median_depth, kMedian);
  copy(images.ids, kId);
}

template <bool kPastCache>
void write_rows(const View& view, const TileBuffer& buffer, int x0, int y0, const Images& images) {
  const int width = view.width - x0 < kTile ? view.width - x0 : kTile;
  const int height = view.height - y0 < kTile ? view.height - y0 : kTile;
  for (int y = 0; y < height; ++y) {
    const size_t row = static_cast<size_t>(y0 + y) * view.width + x0;
    const float* cell = buffer.cell[y / kCell * 8][0] + y % kCell * kCell;
    int x = 0;
    for (; x + kCell <= width; x += kCell, cell += kPlanes * kPixels) {
      write_row<kPastCache>(cell, row + x, images);
    }
    if (x < width) write_some(cell, row + x, width - x, images);
  }
}

// Large images are written past the cache: a row of a tile is a few cache lines, and waiting for
// each to be read first took a tenth of the frame. This pays only where whole lines are written.
inline bool writes_past_cache(const View& view, const Images& images) {
  constexpr int kLine = 64, kLargePixels = 1 << 17;
  const uintptr_t addresses = reinterpret_cast<uintptr_t>(images.rgb) |
                              reinterpret_cast<uintptr_t>(images.depth) |
                              reinterpret_cast<uintptr_t>(images.alpha) |
                              reinterpret_cast<uintptr_t>(images.median_depth) |
                              reinterpret_cast<uintptr_t>(images.ids);
  return view.width * view.height >= kLargePixels && addresses % kLine == 0 &&
         view.width * sizeof(float) % kLine == 0;
}

void write_pixels(const View& view, TileBuffer* buffer, int x0, int y0, uint64_t inside,
                  const Images& images) {
  for (uint64_t m = inside; m; m &= m - 1) {
    finish_cell(buffer->cell[__builtin_ctzll(m)][0], images);
  }
  if (writes_past_cache(view, images)) {
    write_rows<true>(view, *buffer, x0, y0, images);
  } else {
    write_rows<false>(view, *buffer, x0, y0, images);
  }
}

int64_t blend(const View& view, const Splat* splats, const uint64_t* keys, int64_t n, int tile_x,
              int tile_y, const Images& images) {
  TileBuffer buffer;
  Batch batch;
  batch.splats[kBatch] = Splat{};
  batch.splats[kBatch].reach = -1.0f;
  const int x0 = tile_x * kTile, y0 = tile_y * kTile;
  const bool extra = images.median_depth || images.ids;
  clear(&buffer, extra);
  const uint64_t inside = cells_inside(view.width - x0, view.height - y0);
  const auto blend_all = extra ? blend_keys<true> : blend_keys<false>;
  const int64_t evaluated = blend_all(splats, keys, n, static_cast<float>(x0),
                                      static_cast<float>(y0), inside, &batch, &buffer);
  write_pixels(view, &buffer, x0, y0, inside, images);
  return evaluated;
}

// ---------------------------------------------------------------- backward

// With w_i the weight of Gaussian i, a_i its alpha, T_i the transmittance before it and v_i the
// gradient of the loss by w_i:
//   dL/da_i = T_i v_i - sum over j > i of w_j v_j / (1 - a_i).
// The sum over all j is known from the forward pass; what lies before i is taken off it.

// What is kept of a pixel; same size as the forward pass's planes.
enum BackwardPlane { kBackT, kRest, kByRed, kByGreen, kByBlue, kByDepth, kByAlpha };

constexpr int kBackwardBatch = 64;
constexpr int kSums = 10;

// For each Gaussian of a batch, sums over pixels, still W side by side.
struct alignas(64) Sums {
  float sum[kBackwardBatch][kSums][W];
};

// Gradients by rgb, depth and alpha at one pixel become those by the sums of w_i c_i, w_i z_i and
// w_i, and the sum of w_j v_j over all.
void start_pixel(float* cell, int l, size_t at, const Images& images, const ImageGradients& d) {
  const float alpha = cell[kAlpha * kPixels + l], depth_sum = cell[kDepth * kPixels + l];
  const float d_depth = d.depth && alpha > 0 ? d.depth[at] : 0.0f;
  const float by_depth = alpha > 0 ? d_depth / alpha : 0.0f;
  float by_alpha = (d.alpha ? d.alpha[at] : 0.0f);
  if (alpha > 0) by_alpha -= by_depth * depth_sum / alpha;
  float rest = by_depth * depth_sum;
  for (int k = 0; k < 3; ++k) {
    const float by_colour = d.rgb ? d.rgb[at * 3 + k] : 0.0f;
    rest += by_colour * cell[(kRed + k) * kPixels + l];
    by_alpha -= by_colour * images.background[k];
    cell[(kByRed + k) * kPixels + l] = by_colour;
  }
  cell[kBackT * kPixels + l] = 1.0f;
  cell[kRest * kPixels + l] = rest + by_alpha * alpha;
  cell[kByDepth * kPixels + l] = by_depth;
  cell[kByAlpha * kPixels + l] = by_alpha;
}

void start_backward(const View& view, int x0, int y0, uint64_t inside, const Images& images,
                    const ImageGradients& d, TileBuffer* buffer) {
  for (uint64_t m = inside; m; m &= m - 1) {
    const int number = __builtin_ctzll(m);
    float* cell = buffer->cell[number][0];
    for (int l = 0; l < kPixels; ++l) {
      const int x = x0 + kCell * (number & 7) + l % kCell;
      const int y = y0 + kCell * (number >> 3) + l / kCell;
      if (x < view.width && y < view.height) {
        start_pixel(cell, l, static_cast<size_t>(y) * view.width + x, images, d);
      } else {
        // a pixel outside the image counts for nothing
        for (int plane = 0; plane <= kByAlpha; ++plane) cell[plane * kPixels + l] = 0.0f;
      }
    }
  }
}

// One Gaussian over W pixels, its sums added to.
inline void backward_lanes(const Splat& s, F x, F y, float* pixels, float* sums) {
  const F dx = x - splat(s.u), dy = y - splat(s.v);
  const F p = splat(s.along) * dx + splat(s.shear) * dy, q = splat(s.across) * dy;
  F a = splat(s.reach) - p * p - q * q;
  alphas_near<1>(&a);
  const M free = at_least(splat(kAlphaMax), a);
  a = smaller_positive(a, splat(kAlphaMax));
  const auto plane = [&](int k) { return load(pixels + k * kPixels); };
  const F before = plane(kBackT), after = minus_product(before, a, before);
  store(pixels + kBackT * kPixels, after);
  const M alive = at_least(after, splat(kStop));
  const F weight = keep(alive, a * before);
  const F by_weight = plane(kByRed) * splat(s.red) + plane(kByGreen) * splat(s.green) +
                      plane(kByBlue) * splat(s.blue) + plane(kByDepth) * splat(s.z) +
                      plane(kByAlpha);
  const F rest = plane(kRest) - weight * by_weight;
  store(pixels + kRest * kPixels, rest);
  const F by_alpha = before * by_weight - rest / (splat(1.0f) - a);
  const F by_power = keep(both(alive, free), a * by_alpha);
  const F by_p = by_power * p, by_q = by_power * q;
  const F terms[kSums] = {by_p,
                          by_q,
                          by_p * dx,
                          by_p * dy,
                          by_q * dy,
                          by_power,
                          weight * plane(kByRed),
                          weight * plane(kByGreen),
                          weight * plane(kByBlue),
                          weight * plane(kByDepth)};
  for (int k = 0; k < kSums; ++k) store(sums + k * W, load(sums + k * W) + terms[k]);
}

inline bool backward_cell(const Batch& batch, int size, float cell_u, float cell_v,
                          float* pixels, Sums* sums) {
  unsigned unfinished = 0;
  for (int l = 0; l < kPixels; l += W) {
    const F x = splat(cell_u) + load(kPixelOffsets.x + l);
    const F y = splat(cell_v) + load(kPixelOffsets.y + l);
    for (int i = 0; i < size; ++i) {
      const uint32_t number = batch.list[i];
      backward_lanes(batch.splats[number], x, y, pixels + l, sums->sum[number][0]);
    }
    unfinished |= bits(at_least(load(pixels + l), splat(kStop)));
  }
  return unfinished != 0;
}

// The sums over pixels, as gradients by the Gaussian's place and shape in the image.
SplatGradient gather_sums(const Splat& s, const float (*sums)[W]) {
  float total[kSums] = {};
  for (int k = 0; k < kSums; ++k) {
    for (int l = 0; l < W; ++l) total[k] += sums[k][l];
  }
  constexpr float kLn2 = 0.6931471805599453f;  // of alpha = 2^power
  constexpr float kUnit = 2 * kLn2 / kLogUnit, kRoot = -2 * kLn2 / kLogUnitRoot;
  return {s.along * total[0] * kUnit,
          (s.shear * total[0] + s.across * total[1]) * kUnit,
          total[2] * kRoot,
          total[3] * kRoot,
          total[4] * kRoot,
          kLn2 * total[5],
          {total[6], total[7], total[8]},
          total[9]};
}

void blend_backward(const View& view, const Splat* splats, const uint64_t* keys, int64_t n,
                    int tile_x, int tile_y, const Images& images, const ImageGradients& d,
                    SplatGradient* gradients) {
  TileBuffer buffer;
  Batch batch;
  Sums sums;
  batch.splats[kBatch] = Splat{};
  batch.splats[kBatch].reach = -1.0f;
  const int x0 = tile_x * kTile, y0 = tile_y * kTile;
  const float u = static_cast<float>(x0), v = static_cast<float>(y0);
  clear(&buffer, false);
  uint64_t live = cells_inside(view.width - x0, view.height - y0);
  blend_keys<false>(splats, keys, n, u, v, live, &batch, &buffer);
  start_backward(view, x0, y0, live, images, d, &buffer);
  for (int64_t start = 0; start < n; start += kBackwardBatch) {
    const int size = static_cast<int>(n - start < kBackwardBatch ? n - start : kBackwardBatch);
    std::memset(&sums, 0, sizeof(sums));
    if (live) {
      const int padded = stage(splats, keys + start, n - start, size, u, v, &batch);
      live &= ~for_each_cell(&batch, padded, live, [&](int row, int column, int count) {
        return backward_cell(batch, count, u + kCell * column, v + kCell * row,
                             buffer.cell[8 * row + column][0], &sums);
      });
    }
    for (int i = 0; i < size; ++i) {
      gradients[start + i] =
          gather_sums(splats[splat_of(keys[start + i])], sums.sum[i]);
    }
  }
}

}  // namespace

extern const Kernel IGAUSSIAN_KERNEL;
const Kernel IGAUSSIAN_KERNEL = {IGAUSSIAN_KERNEL_NAME, kHalfSh, project, blend, blend_backward};

}  // namespace igaussian
