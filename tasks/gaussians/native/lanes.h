// Sixteen float lanes, one for each pixel of a 4x4 block, in as many registers as the machine needs for them.
#pragma once

#include <cstdint>

#define INLINE static inline __attribute__((always_inline))

#ifdef __clang__
#define SHUFFLE(int_type, a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define SHUFFLE(int_type, a, b, ...) __builtin_shuffle(a, b, int_type{__VA_ARGS__})
#endif

namespace lanes {

template <class H>
struct Pair {
    H lo, hi;
};

typedef float f4 __attribute__((vector_size(16)));
typedef int32_t i4 __attribute__((vector_size(16)));
typedef float f8 __attribute__((vector_size(32)));
typedef int32_t i8 __attribute__((vector_size(32)));

template <class F>
struct IntOf;
template <>
struct IntOf<f4> {
    typedef i4 type;
};
template <>
struct IntOf<f8> {
    typedef i8 type;
};

#if defined(__AVX512F__)
typedef float f16 __attribute__((vector_size(64)));
typedef int32_t i16 __attribute__((vector_size(64)));
template <>
struct IntOf<f16> {
    typedef i16 type;
};
typedef f16 V16;
typedef i16 I16;
#elif defined(__AVX__)
typedef Pair<f8> V16;
typedef Pair<i8> I16;
#else
typedef Pair<Pair<f4>> V16;
typedef Pair<Pair<i4>> I16;
#endif

#define LANES_BINARY(op)                                               \
    template <class H>                                                 \
    INLINE Pair<H> operator op(const Pair<H>& a, const Pair<H>& b) {   \
        return {a.lo op b.lo, a.hi op b.hi};                           \
    }                                                                  \
    template <class H>                                                 \
    INLINE Pair<H> operator op(const Pair<H>& a, float b) {            \
        return {a.lo op b, a.hi op b};                                 \
    }                                                                  \
    template <class H>                                                 \
    INLINE Pair<H> operator op(float a, const Pair<H>& b) {            \
        return {a op b.lo, a op b.hi};                                 \
    }
LANES_BINARY(+)
LANES_BINARY(-)
LANES_BINARY(*)
LANES_BINARY(/)
#undef LANES_BINARY

// a < b ? x : y in each lane.
template <class F, class X>
INLINE X where_less(const F& a, const F& b, const X& x, const X& y) {
    return a < b ? x : y;
}
template <class H, class X>
INLINE Pair<X> where_less(const Pair<H>& a, const Pair<H>& b, const Pair<X>& x, const Pair<X>& y) {
    return {where_less(a.lo, b.lo, x.lo, y.lo), where_less(a.hi, b.hi, x.hi, y.hi)};
}

template <class V>
struct Broadcast {
    INLINE V of(float x) { return V{} + x; }
};
template <class H>
struct Broadcast<Pair<H>> {
    INLINE Pair<H> of(float x) { return {Broadcast<H>::of(x), Broadcast<H>::of(x)}; }
};
INLINE V16 splat(float x) { return Broadcast<V16>::of(x); }

template <class V>
struct BroadcastInt {
    INLINE V of(int32_t x) { return V{} + x; }
};
template <class H>
struct BroadcastInt<Pair<H>> {
    INLINE Pair<H> of(int32_t x) { return {BroadcastInt<H>::of(x), BroadcastInt<H>::of(x)}; }
};
INLINE I16 splat_int(int32_t x) { return BroadcastInt<I16>::of(x); }

INLINE V16 minimum(const V16& a, const V16& b) { return where_less(b, a, b, a); }
INLINE V16 maximum(const V16& a, const V16& b) { return where_less(a, b, b, a); }

INLINE V16 load(const float* p) {
    V16 v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}
INLINE void store(float* p, const V16& v) { __builtin_memcpy(p, &v, sizeof v); }

template <class F>
INLINE float largest(const F& v) {
    float most = v[0];
    for (unsigned k = 1; k < sizeof(F) / sizeof(float); ++k) most = v[k] > most ? v[k] : most;
    return most;
}
template <class H>
INLINE float largest(const Pair<H>& v) {
    return largest(where_less(v.lo, v.hi, v.hi, v.lo));
}

// 2^x for -126 < x < 126; relative error below 3e-7. The sum with 1.5 * 2^23 rounds x and leaves its integer part in
// the low bits of the mantissa: any compiler option that lets (x + c) - c become x breaks it.
template <class F>
INLINE F exp2_lanes(const F& x) {
    typedef typename IntOf<F>::type I;
    const F shifted = x + 12582912.0f;
    const F f = x - (shifted - 12582912.0f);
    const F p = 1.000000072f + f * (6.931469671e-01f + f * (2.402211972e-01f + f * (5.550713275e-02f + f * (9.675541330e-03f + f * 1.327647148e-03f))));
    return (F)((I)p + ((I)shifted << 23));
}
template <class H>
INLINE Pair<H> exp2_lanes(const Pair<H>& x) {
    return {exp2_lanes(x.lo), exp2_lanes(x.hi)};
}

#if defined(__AVX__)
INLINE f8 fold(const V16& v) {
    Pair<f8> halves;
    __builtin_memcpy(&halves, &v, sizeof halves);
    return halves.lo + halves.hi;
}
INLINE f8 join4(const f8& a, const f8& b) {
    return SHUFFLE(i8, a, b, 0, 1, 2, 3, 8, 9, 10, 11) + SHUFFLE(i8, a, b, 4, 5, 6, 7, 12, 13, 14, 15);
}
INLINE f8 join2(const f8& a, const f8& b) {
    return SHUFFLE(i8, a, b, 0, 1, 8, 9, 4, 5, 12, 13) + SHUFFLE(i8, a, b, 2, 3, 10, 11, 6, 7, 14, 15);
}
INLINE f8 join1(const f8& a, const f8& b) {
    return SHUFFLE(i8, a, b, 0, 2, 8, 10, 4, 6, 12, 14) + SHUFFLE(i8, a, b, 1, 3, 9, 11, 5, 7, 13, 15);
}
// Adds the sums over the lanes of ten vectors to ten floats.
INLINE void add_sums(const V16 (&v)[10], float* out) {
    const f8 a = join4(fold(v[0]), fold(v[4])), b = join4(fold(v[1]), fold(v[5]));
    const f8 c = join4(fold(v[2]), fold(v[6])), d = join4(fold(v[3]), fold(v[7]));
    const f8 first = join1(join2(a, b), join2(c, d));
    const f8 e = join4(fold(v[8]), fold(v[9])), zero = {};
    const f8 last = join1(join2(e, zero), zero);
    f8 sum;
    __builtin_memcpy(&sum, out, sizeof sum);
    sum += first;
    __builtin_memcpy(out, &sum, sizeof sum);
    out[8] += last[0];
    out[9] += last[4];
}
#else
INLINE f4 fold(const V16& v) { return (v.lo.lo + v.lo.hi) + (v.hi.lo + v.hi.hi); }
INLINE f4 join2(const f4& a, const f4& b) { return SHUFFLE(i4, a, b, 0, 1, 4, 5) + SHUFFLE(i4, a, b, 2, 3, 6, 7); }
INLINE f4 join1(const f4& a, const f4& b) { return SHUFFLE(i4, a, b, 0, 2, 4, 6) + SHUFFLE(i4, a, b, 1, 3, 5, 7); }
// Adds the sums over the lanes of ten vectors to ten floats.
INLINE void add_sums(const V16 (&v)[10], float* out) {
    const f4 zero = {};
    const f4 sums[3] = {
        join1(join2(fold(v[0]), fold(v[1])), join2(fold(v[2]), fold(v[3]))),
        join1(join2(fold(v[4]), fold(v[5])), join2(fold(v[6]), fold(v[7]))),
        join1(join2(fold(v[8]), fold(v[9])), zero),
    };
    for (int k = 0; k < 10; ++k) out[k] += sums[k / 4][k % 4];
}
#endif

}  // namespace lanes
