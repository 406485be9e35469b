// The projection of kernel.cpp backwards, one Gaussian at a time, in double: differences of
// nearly equal terms cancel here. The names are those of the forward pass; d_x is the gradient of
// the loss by x.
#include "gradient.h"

#include <cmath>

namespace igaussian {
namespace {

constexpr double kLn2 = 0.6931471805599453;
constexpr double kHalfLog2e = 0.5 / kLn2;

// Values and derivatives of the spherical harmonics at (x, y, z) taken as free variables.
int harmonics(const double* d, int count, double* value, double (*slope)[3]) {
  const double x = d[0], y = d[1], z = d[2];
  const double xx = x * x, yy = y * y, zz = z * z;
  const auto set = [&](int k, double c, double v, double dx, double dy, double dz) {
    value[k] = c * v;
    slope[k][0] = c * dx;
    slope[k][1] = c * dy;
    slope[k][2] = c * dz;
  };
  set(0, 0.28209479177387814, 1, 0, 0, 0);
  if (count > 1) {
    const double c = 0.4886025119029199;
    set(1, -c, y, 0, 1, 0);
    set(2, c, z, 0, 0, 1);
    set(3, -c, x, 1, 0, 0);
  }
  if (count > 4) {
    const double c = 1.0925484305920792;
    set(4, c, x * y, y, x, 0);
    set(5, -c, y * z, 0, z, y);
    set(6, 0.31539156525252005, 2 * zz - xx - yy, -2 * x, -2 * y, 4 * z);
    set(7, -c, x * z, z, 0, x);
    set(8, c / 2, xx - yy, 2 * x, -2 * y, 0);
  }
  if (count > 9) {
    const double a = 0.5900435899266435, b = 0.4570457994644658;
    set(9, -a, y * (3 * xx - yy), 6 * x * y, 3 * xx - 3 * yy, 0);
    set(10, 2.890611442640554, x * y * z, y * z, x * z, x * y);
    set(11, -b, y * (4 * zz - xx - yy), -2 * x * y, 4 * zz - xx - 3 * yy, 8 * y * z);
    set(12, 0.3731763325901154, z * (2 * zz - 3 * xx - 3 * yy), -6 * x * z, -6 * y * z,
        6 * zz - 3 * xx - 3 * yy);
    set(13, -b, x * (4 * zz - xx - yy), 4 * zz - 3 * xx - yy, -2 * x * y, 8 * x * z);
    set(14, 1.445305721320277, z * (xx - yy), 2 * x * z, -2 * y * z, xx - yy);
    set(15, -a, x * (xx - 3 * yy), 3 * xx - 3 * yy, -6 * x * y, 0);
  }
  return count;
}

struct Quaternion {
  double w, x, y, z, norm;
};

Quaternion unit(const float* q) {
  const double norm = std::sqrt(double(q[0]) * q[0] + double(q[1]) * q[1] +
                                double(q[2]) * q[2] + double(q[3]) * q[3]);
  if (!(norm > 0)) return {1, 0, 0, 0, 0};
  return {q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm, norm};
}

void rotation(const Quaternion& q, double R[3][3]) {
  const double w = q.w, x = q.x, y = q.y, z = q.z;
  const double rows[3][3] = {
      {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
      {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
      {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
  for (int i = 0; i < 9; ++i) R[i / 3][i % 3] = rows[i / 3][i % 3];
}

// d_R, gradient by the rotation's entries, to the quaternion of any length.
void rotation_backward(const Quaternion& q, const double d[3][3], float* out) {
  if (q.norm == 0) return;
  const double w = q.w, x = q.x, y = q.y, z = q.z;
  const double g[4] = {
      2 * (-z * d[0][1] + y * d[0][2] + z * d[1][0] - x * d[1][2] - y * d[2][0] + x * d[2][1]),
      2 * (y * d[0][1] + z * d[0][2] + y * d[1][0] - 2 * x * d[1][1] - w * d[1][2] +
           z * d[2][0] + w * d[2][1] - 2 * x * d[2][2]),
      2 * (-2 * y * d[0][0] + x * d[0][1] + w * d[0][2] + x * d[1][0] + z * d[1][2] -
           w * d[2][0] + z * d[2][1] - 2 * y * d[2][2]),
      2 * (-2 * z * d[0][0] - w * d[0][1] + x * d[0][2] + w * d[1][0] - 2 * z * d[1][1] +
           y * d[1][2] + x * d[2][0] + y * d[2][1])};
  const double n[4] = {w, x, y, z};
  double along = 0;
  for (int i = 0; i < 4; ++i) along += n[i] * g[i];
  for (int i = 0; i < 4; ++i) out[i] = static_cast<float>((g[i] - n[i] * along) / q.norm);
}

// Gradient by the harmonics' coefficients, and by the direction: added to d_mean and T.
void colour_backward(const Gaussians& g, const View& view, int32_t index,
                     const SplatGradient& d, float* out, double* d_mean, double* T) {
  double away[3], length = 0;
  for (int k = 0; k < 3; ++k) {
    away[k] = double(g.means[int64_t(index) * 3 + k]) - view.centre[k];
    length += away[k] * away[k];
  }
  length = std::sqrt(length);
  for (double& a : away) a /= length;
  double value[16], slope[16][3];
  harmonics(away, g.sh_count, value, slope);
  const float* sh = g.sh + int64_t(index) * g.sh_count * 3;
  float* d_sh = out + int64_t(index) * g.sh_count * 3;
  double d_direction[3] = {0, 0, 0};
  for (int c = 0; c < 3; ++c) {
    double colour = 0.5;
    for (int k = 0; k < g.sh_count; ++k) colour += value[k] * sh[k * 3 + c];
    if (!(colour > 0)) continue;
    for (int k = 0; k < g.sh_count; ++k) {
      d_sh[k * 3 + c] = static_cast<float>(value[k] * d.rgb[c]);
      for (int i = 0; i < 3; ++i) d_direction[i] += slope[k][i] * sh[k * 3 + c] * d.rgb[c];
    }
  }
  // direction = (mean + R^T t) / length
  double radial = 0;
  for (int i = 0; i < 3; ++i) radial += away[i] * d_direction[i];
  for (int i = 0; i < 3; ++i) {
    const double d_away = (d_direction[i] - away[i] * radial) / length;
    d_mean[i] += d_away;
    for (int r = 0; r < 3; ++r) {
      T[r * 4 + i] += view.t[r] * d_away;
      T[r * 4 + 3] += view.R[r * 3 + i] * d_away;
    }
  }
}

}  // namespace

void chain_rule(const Gaussians& g, const View& view, bool antialiased, int32_t index,
                const SplatGradient& d, const Gradients& out, double* T) {
  const float* mean = g.means + int64_t(index) * 3;
  const float* scales = g.scales + int64_t(index) * 3;
  const float* R = view.R;
  double point[3];
  for (int r = 0; r < 3; ++r) {
    point[r] = view.t[r];
    for (int k = 0; k < 3; ++k) point[r] += double(R[r * 3 + k]) * mean[k];
  }
  // forward again, axis by axis: a = 0 for the image's x, 1 for y
  const double z = point[2], focal[2] = {view.fx, view.fy};
  const float* limit[2] = {view.x_limit, view.y_limit};
  const Quaternion q = unit(g.quats_wxyz + int64_t(index) * 4);
  double rot[3][3], ray[2], clamped[2], row[2][3], half[2][3];
  rotation(q, rot);
  for (int a = 0; a < 2; ++a) {
    ray[a] = point[a] / z;
    clamped[a] = std::fmin(std::fmax(ray[a], limit[a][0]), limit[a][1]);
    for (int k = 0; k < 3; ++k) {
      row[a][k] = focal[a] / z * (R[a * 3 + k] - clamped[a] * R[6 + k]);
    }
    for (int j = 0; j < 3; ++j) {
      half[a][j] = 0;
      for (int k = 0; k < 3; ++k) half[a][j] += row[a][k] * rot[k][j] * scales[j];
    }
  }
  double sxx = 0, sxy = 0, syy = 0;
  for (int j = 0; j < 3; ++j) {
    sxx += half[0][j] * half[0][j];
    sxy += half[0][j] * half[1][j];
    syy += half[1][j] * half[1][j];
  }
  const double cxx = sxx + kLowPass, cyy = syy + kLowPass, det = cxx * cyy - sxy * sxy;
  const double slope = sxy / cyy, along = std::sqrt(kHalfLog2e * cyy / det);
  const double across = std::sqrt(kHalfLog2e / cyy);

  // backward: the ellipse
  const double d_slope = -along * d.shear, d_along = d.along - slope * d.shear;
  double d_det = -d_along * along / (2 * det);
  double d_cyy = (d_along * along - d.across * across) / (2 * cyy) - d_slope * slope / cyy;
  double d_sxy = d_slope / cyy, d_cxx = 0;
  if (antialiased) {
    const double det_sharp = sxx * syy - sxy * sxy;
    if (det_sharp > 1e-30 * det) {
      const double d_sharp = 0.5 * d.log_opacity / (kLn2 * det_sharp);
      d_det -= 0.5 * d.log_opacity / (kLn2 * det);
      d_cxx += d_sharp * syy;
      d_cyy += d_sharp * sxx;
      d_sxy -= 2 * d_sharp * sxy;
    }
  }
  d_cxx += d_det * cyy;
  d_cyy += d_det * cxx;
  d_sxy -= 2 * d_det * sxy;
  double d_half[2][3];
  for (int j = 0; j < 3; ++j) {
    d_half[0][j] = 2 * d_cxx * half[0][j] + d_sxy * half[1][j];
    d_half[1][j] = 2 * d_cyy * half[1][j] + d_sxy * half[0][j];
  }

  // the covariance's factor
  double d_rot[3][3];
  for (int j = 0; j < 3; ++j) {
    double d_scale = 0;
    for (int k = 0; k < 3; ++k) {
      const double d_factor = row[0][k] * d_half[0][j] + row[1][k] * d_half[1][j];
      d_rot[k][j] = d_factor * scales[j];
      d_scale += d_factor * rot[k][j];
    }
    out.scales[int64_t(index) * 3 + j] = static_cast<float>(d_scale);
  }
  rotation_backward(q, d_rot, out.quats_wxyz + int64_t(index) * 4);

  // the projection
  double d_point[3] = {0, 0, d.z};
  const double d_pixel[2] = {d.u, d.v};
  for (int a = 0; a < 2; ++a) {
    double d_ray = focal[a] * d_pixel[a], d_clamped = 0, d_gain = 0;
    for (int k = 0; k < 3; ++k) {
      double d_row = 0;
      for (int j = 0; j < 3; ++j) d_row += d_half[a][j] * rot[k][j] * scales[j];
      d_gain += d_row * (R[a * 3 + k] - clamped[a] * R[6 + k]);
      d_clamped -= focal[a] / z * d_row * R[6 + k];
      T[a * 4 + k] += focal[a] / z * d_row;
      T[8 + k] -= focal[a] / z * clamped[a] * d_row;
    }
    if (ray[a] == clamped[a]) d_ray += d_clamped;
    d_point[a] += d_ray / z;
    d_point[2] -= (d_ray * ray[a] + d_gain * focal[a] / z) / z;
  }
  double d_mean[3] = {0, 0, 0};
  for (int r = 0; r < 3; ++r) {
    for (int k = 0; k < 3; ++k) {
      d_mean[k] += R[r * 3 + k] * d_point[r];
      T[r * 4 + k] += d_point[r] * mean[k];
    }
    T[r * 4 + 3] += d_point[r];
  }
  colour_backward(g, view, index, d, out.sh, d_mean, T);
  for (int k = 0; k < 3; ++k) {
    out.means[int64_t(index) * 3 + k] = static_cast<float>(d_mean[k]);
  }
  out.opacities[index] = static_cast<float>(d.log_opacity / (kLn2 * g.opacities[index]));
}

}  // namespace igaussian
