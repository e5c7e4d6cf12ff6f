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
typedef f16 Register;
#elif defined(__AVX__)
typedef Pair<f8> V16;
typedef Pair<i8> I16;
typedef f8 Register;
#else
typedef Pair<Pair<f4>> V16;
typedef Pair<Pair<i4>> I16;
typedef f4 Register;
#endif
// Register: what one register of the machine holds.

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
template <class H>
INLINE Pair<H> operator-(const Pair<H>& a) {
    return {-a.lo, -a.hi};
}

// a < b ? x : y in each lane.
template <class F, class X>
INLINE X where_less(const F& a, const F& b, const X& x, const X& y) {
    return a < b ? x : y;
}
template <class H, class X>
INLINE Pair<X> where_less(const Pair<H>& a, const Pair<H>& b, const Pair<X>& x, const Pair<X>& y) {
    return {where_less(a.lo, b.lo, x.lo, y.lo), where_less(a.hi, b.hi, x.hi, y.hi)};
}

// a == b ? x : y in each lane.
template <class I, class X>
INLINE X where_equal(const I& a, int32_t b, const X& x, const X& y) {
    return a == b ? x : y;
}
template <class H, class X>
INLINE Pair<X> where_equal(const Pair<H>& a, int32_t b, const Pair<X>& x, const Pair<X>& y) {
    return {where_equal(a.lo, b, x.lo, y.lo), where_equal(a.hi, b, x.hi, y.hi)};
}

template <class V>
struct Broadcast {
    INLINE V of(float x) { return x - V{}; }  // 0 + x would be computed, since it makes 0 of -0
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
// The same for numbers above zero, whose bits are in the same order: one instruction, where compilers do not take the
// machine's own minimum of floats for fear of NaN.
template <class F>
INLINE F minimum_of_positive(const F& a, const F& b) {
    typedef typename IntOf<F>::type I;
    return (F)((I)a < (I)b ? (I)a : (I)b);
}
template <class H>
INLINE Pair<H> minimum_of_positive(const Pair<H>& a, const Pair<H>& b) {
    return {minimum_of_positive(a.lo, b.lo), minimum_of_positive(a.hi, b.hi)};
}
INLINE V16 maximum(const V16& a, const V16& b) { return where_less(a, b, b, a); }

INLINE V16 clamp(const V16& x, float low, float high) { return minimum(maximum(x, splat(low)), splat(high)); }
INLINE V16 absolute(const V16& x) { return where_less(x, splat(0), -x, x); }
// 1 where a < b, 0 elsewhere and where either is not a number.
INLINE V16 less(const V16& a, const V16& b) { return where_less(a, b, splat(1), splat(0)); }

// Half by half: a copy of a whole Pair would go through general registers.
template <class V>
struct Memory {
    INLINE V load(const float* p) {
        V v;
        __builtin_memcpy(&v, p, sizeof v);
        return v;
    }
    INLINE void store(float* p, const V& v) { __builtin_memcpy(p, &v, sizeof v); }
};
template <class H>
struct Memory<Pair<H>> {
    static constexpr int half = sizeof(H) / sizeof(float);
    INLINE Pair<H> load(const float* p) { return {Memory<H>::load(p), Memory<H>::load(p + half)}; }
    INLINE void store(float* p, const Pair<H>& v) { Memory<H>::store(p, v.lo), Memory<H>::store(p + half, v.hi); }
};
INLINE V16 load(const float* p) { return Memory<V16>::load(p); }
INLINE void store(float* p, const V16& v) { Memory<V16>::store(p, v); }

INLINE V16 square_root(const V16& x) {
    alignas(64) float lane[16];
    store(lane, x);
    for (float& v : lane) v = __builtin_sqrtf(v);
    return load(lane);
}

template <class F>
INLINE typename IntOf<F>::type truncate_lanes(const F& x) {
    return __builtin_convertvector(x, typename IntOf<F>::type);
}
template <class H>
INLINE auto truncate_lanes(const Pair<H>& x) {
    return Pair<decltype(truncate_lanes(x.lo))>{truncate_lanes(x.lo), truncate_lanes(x.hi)};
}

// 2^x for -126 < x < 126, without meaning elsewhere; relative error below 3e-7. The sum with 1.5 * 2^23 rounds x and leaves its integer part in
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

// log2 of a positive, normal number; absolute error below 1e-6. With m between sqrt(1/2) and sqrt(2) it is
// the exponent + 2 artanh((m - 1) / (m + 1)) / ln 2.
template <class F>
INLINE F log2_lanes(const F& x) {
    typedef typename IntOf<F>::type I;
    const I bits = (I)x, exponent = (bits - 0x3f3504f3) >> 23;
    const F m = (F)(bits - (exponent << 23)), s = (m - 1.0f) / (m + 1.0f), q = s * s;
    return __builtin_convertvector(exponent, F) +
           s * (2.885390082f + q * (0.961796694f + q * (0.577078016f + q * (0.412198583f + q * 0.320598898f))));
}
template <class H>
INLINE Pair<H> log2_lanes(const Pair<H>& x) {
    return {log2_lanes(x.lo), log2_lanes(x.hi)};
}

// Exchanges the lanes of a whose index has the bit `stride` with the lanes of b whose index lacks it.
template <int stride>
INLINE void exchange(f4& a, f4& b) {
    const f4 x = a, y = b;
    if (stride == 1) a = SHUFFLE(i4, x, y, 0, 4, 2, 6), b = SHUFFLE(i4, x, y, 1, 5, 3, 7);
    if (stride == 2) a = SHUFFLE(i4, x, y, 0, 1, 4, 5), b = SHUFFLE(i4, x, y, 2, 3, 6, 7);
}
template <int stride>
INLINE void exchange(f8& a, f8& b) {
    const f8 x = a, y = b;
    if (stride == 1) a = SHUFFLE(i8, x, y, 0, 8, 2, 10, 4, 12, 6, 14), b = SHUFFLE(i8, x, y, 1, 9, 3, 11, 5, 13, 7, 15);
    if (stride == 2) a = SHUFFLE(i8, x, y, 0, 1, 8, 9, 4, 5, 12, 13), b = SHUFFLE(i8, x, y, 2, 3, 10, 11, 6, 7, 14, 15);
    if (stride == 4) a = SHUFFLE(i8, x, y, 0, 1, 2, 3, 8, 9, 10, 11), b = SHUFFLE(i8, x, y, 4, 5, 6, 7, 12, 13, 14, 15);
}
#if defined(__AVX512F__)
template <int stride>
INLINE void exchange(f16& a, f16& b) {
    const f16 x = a, y = b;
    if (stride == 1) {
        a = SHUFFLE(i16, x, y, 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30);
        b = SHUFFLE(i16, x, y, 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31);
    }
    if (stride == 2) {
        a = SHUFFLE(i16, x, y, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29);
        b = SHUFFLE(i16, x, y, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    }
    if (stride == 4) {
        a = SHUFFLE(i16, x, y, 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27);
        b = SHUFFLE(i16, x, y, 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
    }
    if (stride == 8) {
        a = SHUFFLE(i16, x, y, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
        b = SHUFFLE(i16, x, y, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
    }
}
#endif
template <int stride, int count, class V>
INLINE void exchange_all(V (&v)[count]) {
    for (int k = 0; k < count; ++k)
        if (!(k & stride)) exchange<stride>(v[k], v[k + stride]);
}

// All lanes of a vector put together, two by two: exchanged with itself, its lanes meet those that are `stride` away.
template <class F, class Two, int stride = sizeof(F) / 8>
INLINE float folded(const F& v, Two two) {
    F a = v, b = v;
    exchange<stride>(a, b);
    const F both = two(a, b);
    if constexpr (stride > 1)
        return folded<F, Two, stride / 2>(both, two);
    else
        return both[0];
}
template <class F>
INLINE float largest(const F& v) {
    return folded(v, [](const F& a, const F& b) { return a < b ? b : a; });
}
template <class H>
INLINE float largest(const Pair<H>& v) {
    return largest(where_less(v.lo, v.hi, v.hi, v.lo));
}
template <class F>
INLINE float sum(const F& v) {
    return folded(v, [](const F& a, const F& b) { return a + b; });
}
template <class H>
INLINE float sum(const Pair<H>& v) {
    return sum(v.lo + v.hi);
}

// A square of as many vectors as each has lanes: rows become columns.
INLINE void transpose(f4 (&v)[4]) { exchange_all<2>(v), exchange_all<1>(v); }
INLINE void transpose(f8 (&v)[8]) { exchange_all<4>(v), exchange_all<2>(v), exchange_all<1>(v); }
#if defined(__AVX512F__)
INLINE void transpose(f16 (&v)[16]) { exchange_all<8>(v), exchange_all<4>(v), exchange_all<2>(v), exchange_all<1>(v); }
#endif
// Quarter by quarter, so that each stays in registers.
template <class H, int count>
INLINE void transpose(Pair<H> (&v)[count]) {
    H quarter[2][2][count / 2];
    for (int k = 0; k < count / 2; ++k) {
        quarter[0][0][k] = v[k].lo, quarter[1][0][k] = v[k].hi;
        quarter[0][1][k] = v[k + count / 2].lo, quarter[1][1][k] = v[k + count / 2].hi;
    }
    for (auto& half : quarter)
        for (auto& square : half) transpose(square);
    for (int k = 0; k < count / 2; ++k) {
        v[k] = {quarter[0][0][k], quarter[0][1][k]};
        v[k + count / 2] = {quarter[1][0][k], quarter[1][1][k]};
    }
}

}  // namespace lanes
