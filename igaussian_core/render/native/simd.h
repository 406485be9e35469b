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
// 2^floor(q) * p
inline F scale_by_floor(F p, F q) { return _mm512_scalef_ps(p, q); }
inline F fraction(F q) { return _mm512_reduce_ps(q, 0x09); }            // q - floor(q)

#else

#if defined(__AVX2__)
constexpr int W = 8;
constexpr bool kHalfSh = true;
using F = __m256;
using I = __m256i;
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
#else
constexpr int W = 4;
constexpr bool kHalfSh = false;
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
  const I32 b = m & I32{1, 2, 4, 8};
  return static_cast<unsigned>(b[0] | b[1] | b[2] | b[3]);
#endif
}
inline void store_int(int32_t* p, F x) {
  const I32 i = __builtin_convertvector(x, I32);
  __builtin_memcpy(p, &i, sizeof(i));
}
inline F exponent_of(F x) { return __builtin_convertvector(((I32)x >> 23) - 127, F); }
inline F mantissa_of(F x) { return (F)(((I32)x & 0x007fffff) | 0x3f800000); }

#endif

// 2^q for q in [-126, 126], relative error 2.6e-6; garbage outside, NaN for NaN.
// Coefficients: minimax of the relative error, degree 4.
inline F exp2_near(F q) {
#if defined(__AVX512F__)
  const F r = fraction(q);
  F p = r * splat(1.35341673e-2f) + splat(5.20114637e-2f);
  p = p * r + splat(2.41442761e-1f);
  p = p * r + splat(6.93003834e-1f);
  p = p * r + splat(1.00000259f);
  return scale_by_floor(p, q);
#else
  // adding 1.5 * 2^23 rounds to an integer that is left in the low bits
  const F magic = splat(12582912.0f);
  const F shifted = q + magic;
  const F r = q - (shifted - magic);
  F p = r * splat(9.57010300e-3f) + splat(5.59178600e-2f);
  p = p * r + splat(2.40247450e-1f);
  p = p * r + splat(6.93121810e-1f);
  p = p * r + splat(9.99999260e-1f);
  return (F)((I32)p + ((I32)shifted << 23));
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
