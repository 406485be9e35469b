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
// Gaussians whose alphas are computed side by side, those blended between two looks at whether
// the pixels are finished, and vectors of a cell blended side by side: what was fastest
constexpr int kAbreast = 4, kTogether = 8, kVectors = 1;
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
// 1 to 2 with the mantissa bits of x
inline F mantissa_of(I x) {
  const I one = _mm512_set1_epi32(0x3f800000), bits = _mm512_set1_epi32(0x007fffff);
  return _mm512_castsi512_ps(_mm512_ternarylogic_epi32(x, bits, one, 0xea));
}
// x * 2^(exponent bits of by), 0 where by is negative. Integer operations: comparisons into mask
// registers would wait for the multipliers.
inline F raised(F x, I by) {
  const I exponent = _mm512_and_si512(by, _mm512_set1_epi32(~0x007fffff));
  const I product = _mm512_add_epi32(_mm512_castps_si512(x), exponent);
  return _mm512_castsi512_ps(_mm512_andnot_si512(_mm512_srai_epi32(by, 31), product));
}
// smaller(a, b) for a, b >= 0, on any port
inline F smaller_positive(F a, F b) {
  return _mm512_castsi512_ps(_mm512_min_epi32(_mm512_castps_si512(a), _mm512_castps_si512(b)));
}
inline M without(M a, M b) { return a & static_cast<M>(~b); }
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
constexpr int kAbreast = 1, kTogether = 4, kVectors = 2;
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
constexpr int kAbreast = 1, kTogether = 4, kVectors = 4;
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
inline F mantissa_of(I x) { return (F)((x & 0x007fffff) | 0x3f800000); }
inline F raised(F x, I by) { return (F)(~(by >> 31) & ((I)x + (by & ~0x007fffff))); }
inline F smaller_positive(F a, F b) { return smaller(a, b); }
inline M without(M a, M b) { return a & ~b; }
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

// Four floats at a 16-byte aligned place, of any instruction set.
using F4 = float __attribute__((vector_size(16)));
inline F4 load4(const float* p) {
  F4 x;
  __builtin_memcpy(&x, p, sizeof(x));
  return x;
}
template <bool kPastCache>
inline void store4(float* p, F4 x) {
#if defined(__SSE2__)
  if (kPastCache) return _mm_stream_ps(p, x);
#endif
  __builtin_memcpy(p, &x, sizeof(x));
}

// q[i] = 2^(q[i] / 2^23) / 255 for 0 <= q[i] < 2^27, relative error 7.5e-5; 0 for negative ones.
// Rounded to an integer, q has the exponent of the result in its upper bits and a mantissa m in
// [1, 2) below, of which 2^(m - 1) / 255 is a cubic (minimax of the relative error). The loops go
// over independent values because each step waits for the one before.
template <int N>
inline void alphas_near(F* q) {
  I whole[N];
  F m[N], p[N];
  for (int i = 0; i < N; ++i) whole[i] = to_int(q[i]);
  for (int i = 0; i < N; ++i) m[i] = mantissa_of(whole[i]);
  for (int i = 0; i < N; ++i) p[i] = m[i] * splat(3.0597858e-4f) + splat(-3.1397698e-5f);
  for (int i = 0; i < N; ++i) p[i] = p[i] * m[i] + splat(1.8736185e-3f);
  for (int i = 0; i < N; ++i) p[i] = p[i] * m[i] + splat(1.7730761e-3f);
  for (int i = 0; i < N; ++i) q[i] = raised(p[i], whole[i]);
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
