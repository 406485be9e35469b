// A vector of W floats, of one instruction set: AVX-512 (16), AVX2 with FMA (8), or the
// compiler's own 128-bit vectors (4: SSE2, NEON, or plain code).
//
// Arithmetic is written with the operators that GCC and Clang give to vector types; only what
// they lack has a function here. static: see scene.h.
#pragma once
#include <cstdint>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace igaussian {
namespace {

#if defined(__AVX512F__)

constexpr int W = 16;
constexpr bool kHalfSh = true;
// Gaussians whose alphas are computed side by side, and those blended between two looks at
// whether the pixels are finished: what the registers hold
constexpr int kAbreast = 4, kTogether = 8;
using F = __m512;
using M = __mmask16;

inline F splat(float x) { return _mm512_set1_ps(x); }
inline F load(const float* p) { return _mm512_load_ps(p); }
inline void store(float* p, F x) { _mm512_store_ps(p, x); }
inline F load_half(const uint16_t* p) {
  return _mm512_cvtph_ps(_mm256_load_si256(reinterpret_cast<const __m256i*>(p)));
}
inline F smaller(F a, F b) { return _mm512_min_ps(a, b); }
inline F larger(F a, F b) { return _mm512_max_ps(a, b); }
inline F root(F x) { return _mm512_sqrt_ps(x); }
inline M at_least(F a, F b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
inline M above(F a, F b) { return _mm512_cmp_ps_mask(a, b, _CMP_GT_OQ); }
inline M both(M a, M b) { return a & b; }
inline unsigned bits(M m) { return m; }
inline F keep(M m, F x) { return _mm512_maskz_mov_ps(m, x); }          // 0 where not m
inline F pick(M m, F yes, F no) { return _mm512_mask_mov_ps(no, m, yes); }
inline void store_int(int32_t* p, F x) { _mm512_storeu_si512(p, _mm512_cvttps_epi32(x)); }
inline F exponent_of(F x) { return _mm512_getexp_ps(x); }               // floor(log2 x), x > 0
inline F mantissa_of(F x) { return _mm512_getmant_ps(x, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_src); }
// c - a * b, rounded once: GCC would share the product with another use of it
inline F minus_product(F c, F a, F b) { return _mm512_fnmadd_ps(a, b, c); }
// sqrt(x), x > 0, relative error 1.3e-4
inline F rough_root(F x) { return x * _mm512_rsqrt14_ps(x); }
inline F power_of_floor(F x) { return _mm512_scalef_ps(splat(1.0f), x); }  // 2^floor(x)

using I = __m512i;
inline I to_int(F x) { return _mm512_cvttps_epi32(x); }
inline I or_shifted(I a, I b, int shift) { return _mm512_or_si512(a, _mm512_slli_epi32(b, shift)); }
inline void store_int(uint32_t* p, I x) { _mm512_store_si512(p, x); }

inline I load_int(const uint32_t* p) { return _mm512_load_si512(p); }
inline I byte_of(I words, int number) {
  return _mm512_and_si512(_mm512_srli_epi32(words, 8 * number), _mm512_set1_epi32(255));
}
inline M any_bit(I x) { return _mm512_test_epi32_mask(x, x); }
inline M has_bit(I x, int bit) { return _mm512_test_epi32_mask(x, _mm512_set1_epi32(1u << bit)); }
inline I counting_from(int first) {
  const I iota = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  return _mm512_add_epi32(iota, _mm512_set1_epi32(first));
}
inline I low_half(I x) { return _mm512_and_si512(x, _mm512_set1_epi32(0xffff)); }
// Appends the lanes of x that are in m; writes up to W values past the new end.
inline int append(M m, I x, uint32_t* list, int size) {
  _mm512_storeu_si512(list + size, _mm512_maskz_compress_epi32(m, x));
  return size + __builtin_popcount(m);
}

inline void transpose(const F* in, F* out) {
  F a[16], b[16];
  for (int i = 0; i < 16; i += 2) {
    a[i] = _mm512_unpacklo_ps(in[i], in[i + 1]);
    a[i + 1] = _mm512_unpackhi_ps(in[i], in[i + 1]);
  }
  for (int i = 0; i < 16; i += 4) {
    b[i] = _mm512_shuffle_ps(a[i], a[i + 2], 0x44);
    b[i + 1] = _mm512_shuffle_ps(a[i], a[i + 2], 0xee);
    b[i + 2] = _mm512_shuffle_ps(a[i + 1], a[i + 3], 0x44);
    b[i + 3] = _mm512_shuffle_ps(a[i + 1], a[i + 3], 0xee);
  }
  // b[4 * j + i]: quarter q holds in[4j] ... in[4j + 3] at 4q + i
  for (int i = 0; i < 4; ++i) {
    const F x = _mm512_shuffle_f32x4(b[i], b[i + 4], 0x44);
    const F y = _mm512_shuffle_f32x4(b[i], b[i + 4], 0xee);
    const F z = _mm512_shuffle_f32x4(b[i + 8], b[i + 12], 0x44);
    const F w = _mm512_shuffle_f32x4(b[i + 8], b[i + 12], 0xee);
    out[i] = _mm512_shuffle_f32x4(x, z, 0x88);
    out[i + 4] = _mm512_shuffle_f32x4(x, z, 0xdd);
    out[i + 8] = _mm512_shuffle_f32x4(y, w, 0x88);
    out[i + 12] = _mm512_shuffle_f32x4(y, w, 0xdd);
  }
}

// 16 fields of W Gaussians each, to W lines of 16 floats.
inline void to_lines(const F* rows, float* lines) {
  F out[16];
  transpose(rows, out);
  for (int i = 0; i < 16; ++i) store(lines + i * 16, out[i]);
}

// The given fields of W lines of 16 floats.
template <int kCount>
inline void from_lines(const float* lines, const int (&fields)[kCount], F* rows) {
  F in[16], out[16];
  for (int i = 0; i < 16; ++i) in[i] = load(lines + i * 16);
  transpose(in, out);
  for (int k = 0; k < kCount; ++k) rows[k] = out[fields[k]];
}

#else

#if defined(__AVX2__)
constexpr int W = 8;
constexpr bool kHalfSh = true;
constexpr int kAbreast = 2, kTogether = 8;
using F = __m256;
using I32 = int32_t __attribute__((vector_size(32)));

inline F splat(float x) { return _mm256_set1_ps(x); }
inline F load(const float* p) { return _mm256_load_ps(p); }
inline void store(float* p, F x) { _mm256_store_ps(p, x); }
inline F load_half(const uint16_t* p) {
  return _mm256_cvtph_ps(_mm_load_si128(reinterpret_cast<const __m128i*>(p)));
}
inline F smaller(F a, F b) { return _mm256_min_ps(a, b); }
inline F larger(F a, F b) { return _mm256_max_ps(a, b); }
inline F root(F x) { return _mm256_sqrt_ps(x); }
inline F minus_product(F c, F a, F b) { return _mm256_fnmadd_ps(a, b, c); }
inline F rough_root(F x) { return x * _mm256_rsqrt_ps(x); }  // relative error 4e-4
#else
constexpr int W = 4;
constexpr bool kHalfSh = false;
constexpr int kAbreast = 2, kTogether = 8;
using F = float __attribute__((vector_size(16)));
using I32 = int32_t __attribute__((vector_size(16)));

inline F splat(float x) { return F{x, x, x, x}; }
inline F load(const float* p) { return *reinterpret_cast<const F*>(p); }
inline void store(float* p, F x) { *reinterpret_cast<F*>(p) = x; }
inline F load_half(const uint16_t*) { return F{}; }
inline F smaller(F a, F b) { return a < b ? a : b; }
inline F larger(F a, F b) { return a > b ? a : b; }
inline F root(F x) {
  return F{__builtin_sqrtf(x[0]), __builtin_sqrtf(x[1]), __builtin_sqrtf(x[2]),
           __builtin_sqrtf(x[3])};
}
inline F minus_product(F c, F a, F b) { return c - a * b; }
#if defined(__SSE2__)
inline F rough_root(F x) { return x * _mm_rsqrt_ps(x); }
#else
inline F rough_root(F x) { return root(x); }
#endif
#endif

using M = I32;  // all bits of a lane set, or none
inline M at_least(F a, F b) { return (M)(a >= b); }
inline M above(F a, F b) { return (M)(a > b); }
inline M both(M a, M b) { return a & b; }
inline F keep(M m, F x) { return (F)(m & (I32)x); }
inline F pick(M m, F yes, F no) { return (F)((m & (I32)yes) | (~m & (I32)no)); }
inline unsigned bits(M m) {
#if defined(__AVX2__)
  return static_cast<unsigned>(_mm256_movemask_ps((F)m));
#elif defined(__SSE2__)
  return static_cast<unsigned>(_mm_movemask_ps((F)m));
#else
  const I32 b = (m >> 31) & I32{1, 2, 4, 8};
  return static_cast<unsigned>(b[0] | b[1] | b[2] | b[3]);
#endif
}
inline void store_int(int32_t* p, F x) {
  const I32 i = __builtin_convertvector(x, I32);
  __builtin_memcpy(p, &i, sizeof(i));
}
inline F exponent_of(F x) { return __builtin_convertvector(((I32)x >> 23) - 127, F); }
inline F mantissa_of(F x) { return (F)(((I32)x & 0x007fffff) | 0x3f800000); }
inline F power_of_floor(F x) {  // 2^floor(x), 0 <= x < 127
  return (F)((__builtin_convertvector(x, I32) + 127) << 23);
}

using I = I32;
inline I to_int(F x) { return __builtin_convertvector(x, I); }
inline I or_shifted(I a, I b, int shift) { return a | (b << shift); }
inline void store_int(uint32_t* p, I x) { *reinterpret_cast<I*>(p) = x; }

inline I load_int(const uint32_t* p) { return *reinterpret_cast<const I*>(p); }
inline I byte_of(I words, int number) { return (words >> (8 * number)) & 255; }
inline M any_bit(I x) { return (M)(x != 0); }
inline M has_bit(I x, int bit) { return x << (31 - bit); }  // only the sign counts
inline I counting_from(int first) {
  I x;
  for (int l = 0; l < W; ++l) x[l] = first + l;
  return x;
}
inline I low_half(I x) { return x & 0xffff; }

#if defined(__AVX2__)
// Numbers of the lanes set in each possible mask, first lanes first.
struct LaneTable {
  uint8_t lanes[1 << W][W];
  constexpr LaneTable() : lanes() {
    for (int mask = 0; mask < 1 << W; ++mask) {
      int size = 0;
      for (int lane = 0; lane < W; ++lane) {
        if (mask >> lane & 1) lanes[mask][size++] = static_cast<uint8_t>(lane);
      }
    }
  }
};
constexpr LaneTable kLaneTable;

inline int append(M m, I x, uint32_t* list, int size) {
  const unsigned set = bits(m);
  const __m256i lanes = _mm256_cvtepu8_epi32(
      _mm_loadl_epi64(reinterpret_cast<const __m128i*>(kLaneTable.lanes[set])));
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(list + size),
                      _mm256_permutevar8x32_epi32((__m256i)x, lanes));
  return size + __builtin_popcount(set);
}
#else
inline int append(M m, I x, uint32_t* list, int size) {
  for (int l = 0; l < W; ++l) {  // no branch: it could not be foreseen
    list[size] = static_cast<uint32_t>(x[l]);
    size += static_cast<int>(static_cast<uint32_t>(m[l]) >> 31);
  }
  return size;
}
#endif

inline void to_lines(const F* rows, float* lines) {
  for (int k = 0; k < 16; ++k) {
    for (int l = 0; l < W; ++l) lines[l * 16 + k] = rows[k][l];
  }
}
template <int kCount>
inline void from_lines(const float* lines, const int (&fields)[kCount], F* rows) {
  for (int k = 0; k < kCount; ++k) {
    for (int l = 0; l < W; ++l) rows[k][l] = lines[l * 16 + fields[k]];
  }
}

#endif

// q[i] = 2^q[i] for q in [-126, 126], relative error 7.5e-5; garbage outside, NaN for NaN.
// Coefficients: minimax of the relative error, degree 3. The loops go over independent values
// because each step waits for the one before.
template <int N>
inline void exp2_near(F* q) {
  F r[N], p[N];
#if defined(__AVX512F__)
  for (int i = 0; i < N; ++i) r[i] = _mm512_reduce_ps(q[i], 0x09);  // q - floor(q)
  constexpr float c[4] = {9.99925220e-1f, 6.95833540e-1f, 2.26067160e-1f, 7.80245200e-2f};
#else
  // adding 1.5 * 2^23 rounds to an integer that is left in the low bits
  const F magic = splat(12582912.0f);
  F shifted[N];
  for (int i = 0; i < N; ++i) shifted[i] = q[i] + magic;
  for (int i = 0; i < N; ++i) r[i] = q[i] - (shifted[i] - magic);
  constexpr float c[4] = {9.99928070e-1f, 6.93260990e-1f, 2.42611110e-1f, 5.51716700e-2f};
#endif
  for (int i = 0; i < N; ++i) p[i] = r[i] * splat(c[3]) + splat(c[2]);
  for (int i = 0; i < N; ++i) p[i] = p[i] * r[i] + splat(c[1]);
  for (int i = 0; i < N; ++i) p[i] = p[i] * r[i] + splat(c[0]);
#if defined(__AVX512F__)
  for (int i = 0; i < N; ++i) q[i] = _mm512_scalef_ps(p[i], q[i]);
#else
  for (int i = 0; i < N; ++i) q[i] = (F)((I)p[i] + ((I)shifted[i] << 23));
#endif
}

// log2(x) for x > 0, absolute error 2e-6: series of atanh on a mantissa in [0.75, 1.5).
inline F log2_near(F x) {
  F e = exponent_of(x), m = mantissa_of(x);
  const M upper = at_least(m, splat(1.5f));
  m = pick(upper, m * splat(0.5f), m);
  e = e + keep(upper, splat(1.0f));
  const F s = (m - splat(1.0f)) / (m + splat(1.0f)), s2 = s * s;
  F p = s2 * splat(0.41219858f) + splat(0.57707802f);
  p = p * s2 + splat(0.96179669f);
  p = p * s2 + splat(2.88539008f);
  return e + p * s;
}

}  // namespace
}  // namespace igaussian
