// The most that the fused multiply-add units of one thread give: twelve independent chains of vectors.
#include <cstdint>
#include <ctime>

#if defined(__AVX512F__)
constexpr int kBytes = 64;
#elif defined(__AVX__)
constexpr int kBytes = 32;
#else
constexpr int kBytes = 16;
#endif
typedef float V __attribute__((vector_size(kBytes)));

// GFLOP/s of processor time over so many rounds; `seed` keeps the compiler from knowing the result, which goes to `sink`.
extern "C" double fma_peak(int64_t rounds, float seed, float* sink) {
    V x[12];
    for (int k = 0; k < 12; ++k) x[k] = V{} + seed * (k + 1);
    const V a = V{} + (1 - seed * 1e-6f), b = V{} + seed * 1e-6f;
    const std::clock_t start = std::clock();
    for (int64_t r = 0; r < rounds; ++r)
        for (int k = 0; k < 12; ++k) x[k] = x[k] * a + b;
    const double taken = double(std::clock() - start) / CLOCKS_PER_SEC;
    V sum = x[0];
    for (int k = 1; k < 12; ++k) sum += x[k];
    *sink = sum[0];
    return rounds * 12.0 * 2 * (kBytes / 4) / taken / 1e9;
}
