// Sixteen floats as one value: one AVX-512 register, two AVX registers or four of 128 bits, so
// that loops read like formulas. Lives in a namespace of its own for every instruction set,
// because the linker would merge equal names that were compiled with different flags.
#pragma once

#include <cstdint>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#define RGBAVATAR_FUNCTION static inline __attribute__((always_inline))
#define RGBAVATAR_MEMBER inline __attribute__((always_inline))

namespace rgbavatar::RGBAVATAR_ISA {

#if defined(__AVX512F__)
constexpr int kNativeLanes = 16;
#elif defined(__AVX2__)
constexpr int kNativeLanes = 8;
#else
constexpr int kNativeLanes = 4;
#endif
constexpr int kLanes = 16;

typedef float NativeFloat __attribute__((vector_size(4 * kNativeLanes)));
typedef float UnalignedFloat __attribute__((vector_size(4 * kNativeLanes), aligned(4)));
typedef int32_t NativeInt __attribute__((vector_size(4 * kNativeLanes)));
typedef uint32_t NativeUnsigned __attribute__((vector_size(4 * kNativeLanes)));
#if defined(__AVX512F__)
typedef __mmask16 NativeMask;
#else
typedef NativeInt NativeMask;
#endif

template <int Lanes>
struct Mask {
  Mask<Lanes / 2> low, high;
  friend RGBAVATAR_MEMBER Mask operator&(Mask a, Mask b) {
    return {a.low & b.low, a.high & b.high};
  }
};

template <>
struct Mask<kNativeLanes> {
  NativeMask m;
  friend RGBAVATAR_MEMBER Mask operator&(Mask a, Mask b) { return {NativeMask(a.m & b.m)}; }
};

template <int Lanes>
struct Floats {
  typedef Floats<Lanes / 2> Half;
  Half low, high;
  Floats() = default;
  RGBAVATAR_MEMBER Floats(Half l, Half h) : low(l), high(h) {}
  RGBAVATAR_MEMBER Floats(float s) : low(s), high(s) {}
#define RGBAVATAR_PAIRWISE(op) \
  friend RGBAVATAR_MEMBER Floats operator op(Floats a, Floats b) { \
    return {a.low op b.low, a.high op b.high}; \
  }
#define RGBAVATAR_PAIRWISE_COMPARE(op) \
  friend RGBAVATAR_MEMBER Mask<Lanes> operator op(Floats a, Floats b) { \
    return {a.low op b.low, a.high op b.high}; \
  }
  RGBAVATAR_PAIRWISE(+)
  RGBAVATAR_PAIRWISE(-)
  RGBAVATAR_PAIRWISE(*)
  RGBAVATAR_PAIRWISE(/)
  RGBAVATAR_PAIRWISE_COMPARE(>=)
  RGBAVATAR_PAIRWISE_COMPARE(<=)
  RGBAVATAR_PAIRWISE_COMPARE(>)
  RGBAVATAR_PAIRWISE_COMPARE(==)
#undef RGBAVATAR_PAIRWISE
#undef RGBAVATAR_PAIRWISE_COMPARE
};

template <>
struct Floats<kNativeLanes> {
  NativeFloat v;
  Floats() = default;
  RGBAVATAR_MEMBER explicit Floats(NativeFloat n) : v(n) {}
  RGBAVATAR_MEMBER Floats(float s) : v(s - NativeFloat{}) {}
#define RGBAVATAR_NATIVE(op) \
  friend RGBAVATAR_MEMBER Floats operator op(Floats a, Floats b) { return Floats(a.v op b.v); }
#if defined(__AVX512F__)
#define RGBAVATAR_NATIVE_COMPARE(op, code) \
  friend RGBAVATAR_MEMBER Mask<kNativeLanes> operator op(Floats a, Floats b) { \
    return {_mm512_cmp_ps_mask(a.v, b.v, code)}; \
  }
#else
#define RGBAVATAR_NATIVE_COMPARE(op, code) \
  friend RGBAVATAR_MEMBER Mask<kNativeLanes> operator op(Floats a, Floats b) { \
    return {a.v op b.v}; \
  }
#endif
  RGBAVATAR_NATIVE(+)
  RGBAVATAR_NATIVE(-)
  RGBAVATAR_NATIVE(*)
  RGBAVATAR_NATIVE(/)
  RGBAVATAR_NATIVE_COMPARE(>=, _CMP_GE_OQ)
  RGBAVATAR_NATIVE_COMPARE(<=, _CMP_LE_OQ)
  RGBAVATAR_NATIVE_COMPARE(>, _CMP_GT_OQ)
  RGBAVATAR_NATIVE_COMPARE(==, _CMP_EQ_OQ)
#undef RGBAVATAR_NATIVE
#undef RGBAVATAR_NATIVE_COMPARE
};

// Sixteen 32-bit integers, for bounds and masks.
template <int Lanes>
struct Ints {
  typedef Ints<Lanes / 2> Half;
  Half low, high;
  Ints() = default;
  RGBAVATAR_MEMBER Ints(Half l, Half h) : low(l), high(h) {}
  RGBAVATAR_MEMBER Ints(int32_t s) : low(s), high(s) {}
#define RGBAVATAR_PAIRWISE(op) \
  friend RGBAVATAR_MEMBER Ints operator op(Ints a, Ints b) { \
    return {a.low op b.low, a.high op b.high}; \
  }
  RGBAVATAR_PAIRWISE(+)
  RGBAVATAR_PAIRWISE(-)
  RGBAVATAR_PAIRWISE(|)
  RGBAVATAR_PAIRWISE(&)
  RGBAVATAR_PAIRWISE(<<)
  RGBAVATAR_PAIRWISE(>>)
#undef RGBAVATAR_PAIRWISE
};

template <>
struct Ints<kNativeLanes> {
  NativeInt v;
  Ints() = default;
  RGBAVATAR_MEMBER explicit Ints(NativeInt n) : v(n) {}
  RGBAVATAR_MEMBER Ints(int32_t s) : v(s - NativeInt{}) {}
#define RGBAVATAR_NATIVE(op) \
  friend RGBAVATAR_MEMBER Ints operator op(Ints a, Ints b) { return Ints(a.v op b.v); }
  RGBAVATAR_NATIVE(+)
  RGBAVATAR_NATIVE(-)
  RGBAVATAR_NATIVE(|)
  RGBAVATAR_NATIVE(&)
  RGBAVATAR_NATIVE(<<)
  RGBAVATAR_NATIVE(>>)
#undef RGBAVATAR_NATIVE
};

typedef Floats<kLanes> Wide;
typedef Floats<kNativeLanes> Native;
typedef Ints<kLanes> WideInt;
typedef Ints<kNativeLanes> NativeInts;
typedef Mask<kLanes> WideMask;
typedef Mask<kNativeLanes> Flags;

// ---- one register -----------------------------------------------------------------------------

RGBAVATAR_FUNCTION Native select(Flags m, Native a, Native b) {
#if defined(__AVX512F__)
  return Native(_mm512_mask_blend_ps(m.m, b.v, a.v));
#else
  return Native(m.m ? a.v : b.v);
#endif
}

// Towards zero.
RGBAVATAR_FUNCTION NativeInts to_ints(Native a) {
  return NativeInts(__builtin_convertvector(a.v, NativeInt));
}
RGBAVATAR_FUNCTION Native to_floats(NativeInts a) {
  return Native(__builtin_convertvector(a.v, NativeFloat));
}
RGBAVATAR_FUNCTION Native bits_as_floats(NativeInts a) { return Native((NativeFloat)a.v); }

RGBAVATAR_FUNCTION Native min_of(Native a, Native b) {
#if defined(__AVX512F__)
  return Native(_mm512_min_ps(a.v, b.v));
#else
  return Native(a.v < b.v ? a.v : b.v);
#endif
}
RGBAVATAR_FUNCTION Native max_of(Native a, Native b) {
#if defined(__AVX512F__)
  return Native(_mm512_max_ps(a.v, b.v));
#else
  return Native(a.v > b.v ? a.v : b.v);
#endif
}

RGBAVATAR_FUNCTION bool any(Flags m) {
#if defined(__AVX512F__)
  return m.m != 0;
#elif defined(__AVX2__)
  return _mm256_movemask_ps((__m256)m.m) != 0;
#elif defined(__x86_64__)
  return _mm_movemask_ps((__m128)m.m) != 0;
#else
  return (m.m[0] | m.m[1] | m.m[2] | m.m[3]) != 0;
#endif
}

RGBAVATAR_FUNCTION Native square_root(Native a) {
#if defined(__AVX512F__)
  return Native(_mm512_sqrt_ps(a.v));
#elif defined(__AVX2__)
  return Native(_mm256_sqrt_ps(a.v));
#elif defined(__x86_64__)
  return Native(_mm_sqrt_ps(a.v));
#else
  for (int i = 0; i < kNativeLanes; ++i) a.v[i] = __builtin_sqrtf(a.v[i]);
  return a;
#endif
}

// 1 / a to about 23 bits: the hardware's estimate and one Newton step.
RGBAVATAR_FUNCTION Native reciprocal_of(Native a) {
#if defined(__AVX512F__)
  const Native estimate(_mm512_rcp14_ps(a.v));
#elif defined(__AVX2__)
  const Native estimate(_mm256_rcp_ps(a.v));
#elif defined(__x86_64__)
  const Native estimate(_mm_rcp_ps(a.v));
#else
  return Native(1.0f) / a;
#endif
#if defined(__x86_64__)
  return estimate + estimate * (Native(1.0f) - a * estimate);
#endif
}

// 1 / sqrt(a) of a positive, normal number, to about 23 bits, in the same way.
RGBAVATAR_FUNCTION Native inverse_root_of(Native a) {
#if defined(__AVX512F__)
  const Native estimate(_mm512_rsqrt14_ps(a.v));
#elif defined(__AVX2__)
  const Native estimate(_mm256_rsqrt_ps(a.v));
#elif defined(__x86_64__)
  const Native estimate(_mm_rsqrt_ps(a.v));
#else
  return Native(1.0f) / square_root(a);
#endif
#if defined(__x86_64__)
  return estimate * (Native(1.5f) - Native(0.5f) * a * estimate * estimate);
#endif
}

// 2^a where the mask is set and 0 elsewhere, relative error 3e-6; -126 < a < 127 where it is set.
// The minimax polynomial of degree 4 on [0, 1) for the fraction, and the floor for the exponent.
RGBAVATAR_FUNCTION Native exp2_where(Flags m, Native a) {
#if defined(__AVX512F__)
  const Native f(_mm512_reduce_ps(a.v, _MM_FROUND_TO_NEG_INF));
#else
  // Adding 1.5 * 2^23 rounds to the nearest integer and leaves it in the low bits.
  const Native shifted = (a - Native(0.5f)) + Native(12582912.0f);
  const Native f = a - (shifted - Native(12582912.0f));
#endif
  const Native f2 = f * f;  // Estrin's order: short chains, because latency is what counts here
  const Native low = Native(0.69300383329391479f) * f + Native(1.0000026226043701f);
  const Native middle = Native(0.052011460065841675f) * f + Native(0.24144275486469269f);
  const Native p = (Native(0.013534167781472206f) * f2 + middle) * f2 + low;
#if defined(__AVX512F__)
  return Native(_mm512_maskz_scalef_ps(m.m, p.v, a.v));
#else
  // Unsigned, because lanes that the mask drops may overflow.
  const Native scaled((NativeFloat)((NativeUnsigned)p.v + ((NativeUnsigned)shifted.v << 23)));
  return select(m, scaled, Native(0.0f));
#endif
}

// Log2 of a positive, normal number: the mantissa m in [1/sqrt 2, sqrt 2) through the odd series
// of atanh in (m - 1) / (m + 1).
RGBAVATAR_FUNCTION Native log2_of(Native a) {
  const NativeInt bits = (NativeInt)a.v - 0x3f3504f3;
  const Native exponent(__builtin_convertvector(bits >> 23, NativeFloat));
  const Native m((NativeFloat)((bits & 0x7fffff) + 0x3f3504f3));
  const Native s = (m - Native(1.0f)) / (m + Native(1.0f)), s2 = s * s;
  Native p(0.3205989f);  // (2 / ln 2) / 9, / 7, / 5, / 3, / 1
  p = p * s2 + Native(0.41219860f);
  p = p * s2 + Native(0.57707802f);
  p = p * s2 + Native(0.96179669f);
  p = p * s2 + Native(2.88539008f);
  return p * s + exponent;
}

RGBAVATAR_FUNCTION void load(Native& a, const float* from) {
  a.v = *reinterpret_cast<const UnalignedFloat*>(from);
}
RGBAVATAR_FUNCTION void store(Native a, float* to) {
  *reinterpret_cast<UnalignedFloat*>(to) = a.v;
}

// ---- pairs of halves --------------------------------------------------------------------------

#define RGBAVATAR_HALVES1(name) \
  template <int L> \
  RGBAVATAR_FUNCTION Floats<L> name(Floats<L> a) { \
    return {name(a.low), name(a.high)}; \
  }
#define RGBAVATAR_HALVES1_OF(name, To, From) \
  template <int L> \
  RGBAVATAR_FUNCTION To<L> name(From<L> a) { \
    return {name(a.low), name(a.high)}; \
  }
#define RGBAVATAR_HALVES2(name) \
  template <int L> \
  RGBAVATAR_FUNCTION Floats<L> name(Floats<L> a, Floats<L> b) { \
    return {name(a.low, b.low), name(a.high, b.high)}; \
  }
RGBAVATAR_HALVES1(square_root)
RGBAVATAR_HALVES1(reciprocal_of)
RGBAVATAR_HALVES1(inverse_root_of)
RGBAVATAR_HALVES1(log2_of)
RGBAVATAR_HALVES2(min_of)
RGBAVATAR_HALVES2(max_of)
RGBAVATAR_HALVES1_OF(to_ints, Ints, Floats)
RGBAVATAR_HALVES1_OF(to_floats, Floats, Ints)
RGBAVATAR_HALVES1_OF(bits_as_floats, Floats, Ints)
#undef RGBAVATAR_HALVES1
#undef RGBAVATAR_HALVES1_OF
#undef RGBAVATAR_HALVES2

template <int L>
RGBAVATAR_FUNCTION Floats<L> select(Mask<L> m, Floats<L> a, Floats<L> b) {
  return {select(m.low, a.low, b.low), select(m.high, a.high, b.high)};
}
template <int L>
RGBAVATAR_FUNCTION Floats<L> exp2_where(Mask<L> m, Floats<L> a) {
  return {exp2_where(m.low, a.low), exp2_where(m.high, a.high)};
}
template <int L>
RGBAVATAR_FUNCTION bool any(Mask<L> m) {
  return any(m.low) || any(m.high);
}
template <int L>
RGBAVATAR_FUNCTION void load(Floats<L>& a, const float* from) {
  load(a.low, from);
  load(a.high, from + L / 2);
}
template <int L>
RGBAVATAR_FUNCTION void store(Floats<L> a, float* to) {
  store(a.low, to);
  store(a.high, to + L / 2);
}

RGBAVATAR_FUNCTION Wide load_wide(const float* from) {
  Wide a;
  load(a, from);
  return a;
}

RGBAVATAR_FUNCTION void load(NativeInts& a, const int32_t* from) {
  __builtin_memcpy(&a.v, from, sizeof a.v);
}
template <int L>
RGBAVATAR_FUNCTION void load(Ints<L>& a, const int32_t* from) {
  load(a.low, from);
  load(a.high, from + L / 2);
}
RGBAVATAR_FUNCTION WideInt load_ints(const int32_t* from) {
  WideInt a;
  load(a, from);
  return a;
}

RGBAVATAR_FUNCTION Native sum_to_register(Native a) { return a; }
template <int L>
RGBAVATAR_FUNCTION Native sum_to_register(Floats<L> a) {
  return sum_to_register(a.low + a.high);
}

}  // namespace rgbavatar::RGBAVATAR_ISA
