// Vectors of kLanes floats, and the few functions the rasteriser needs of them.
//
// GCC's and Clang's vector extensions let one source serve every instruction set: operators work
// lane by lane, comparisons give a Mask (all bits set where true), and `mask ? a : b` selects.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <new>
#include <utility>

#if defined(__AVX2__)
#include <immintrin.h>
#endif
#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace bdgs {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
typedef float Lanes __attribute__((vector_size(64)));
typedef int32_t Mask __attribute__((vector_size(64)));
#else
constexpr int kLanes = 8;
typedef float Lanes __attribute__((vector_size(32)));
typedef int32_t Mask __attribute__((vector_size(32)));
#endif

constexpr float kLog2E = 1.4426950408889634f;

inline Lanes splat(float value) { return value - Lanes{}; }

inline Lanes load(const float* from) {
  Lanes v;
  std::memcpy(&v, from, sizeof(v));
  return v;
}

inline void store(float* to, Lanes v) { std::memcpy(to, &v, sizeof(v)); }

inline Mask bits_of(Lanes v) { return reinterpret_cast<Mask>(v); }
inline Lanes from_bits(Mask v) { return reinterpret_cast<Lanes>(v); }

// NaN in either argument gives b: `min(limit, v)` lets a NaN through, `min(v, limit)` does not.
inline Lanes min(Lanes a, Lanes b) { return a < b ? a : b; }
inline Lanes max(Lanes a, Lanes b) { return a > b ? a : b; }
inline Lanes abs(Lanes v) { return from_bits(bits_of(v) & 0x7fffffff); }

inline bool any(Mask mask) {
#if defined(__AVX512DQ__)
  return _mm512_movepi32_mask(reinterpret_cast<__m512i>(mask)) != 0;
#elif defined(__AVX2__)
  return _mm256_movemask_ps(reinterpret_cast<__m256>(mask)) != 0;
#else
  int32_t joined = 0;
  for (int i = 0; i < kLanes; ++i) joined |= mask[i];
  return joined != 0;
#endif
}

inline Lanes sqrt(Lanes v) {
#if defined(__AVX512F__)
  return reinterpret_cast<Lanes>(_mm512_sqrt_ps(reinterpret_cast<__m512>(v)));
#elif defined(__AVX2__)
  return reinterpret_cast<Lanes>(_mm256_sqrt_ps(reinterpret_cast<__m256>(v)));
#else
  for (int i = 0; i < kLanes; ++i) v[i] = std::sqrt(v[i]);
  return v;
#endif
}

// 1 / v to the last bit or two, without the division unit where there is an estimate.
inline Lanes reciprocal(Lanes v) {
#if defined(__AVX512F__)
  const Lanes r = reinterpret_cast<Lanes>(_mm512_rcp14_ps(reinterpret_cast<__m512>(v)));
  return r * (2.0f - v * r);
#elif defined(__AVX2__)
  Lanes r = reinterpret_cast<Lanes>(_mm256_rcp_ps(reinterpret_cast<__m256>(v)));
  return r * (2.0f - v * r);
#else
  return 1.0f / v;
#endif
}

// 2^v for v in [-126, 126]; relative error 2e-7 (fitted polynomial of degree 5).
inline Lanes exp2(Lanes v) {
  const float round = 12582912.0f;  // 1.5 * 2^23: adding it leaves the integer in the low bits
  const Lanes shifted = v + round;
  const Lanes f = v - (shifted - round);
  Lanes p = f * 0.00132765f + 0.00967554f;
  p = p * f + 0.05550713f;
  p = p * f + 0.2402212f;
  p = p * f + 0.69314697f;
  p = p * f + 1.00000007f;
  return from_bits(bits_of(p) + (bits_of(shifted) << 23));
}

// log2(v) for normal v > 0; absolute error 1e-7 (series of atanh around 1).
inline Lanes log2(Lanes v) {
  const Mask exponent = (bits_of(v) - 0x3f3504f3) >> 23;
  const Lanes mantissa = from_bits(bits_of(v) - (exponent << 23));
  const Lanes s = (mantissa - 1.0f) / (mantissa + 1.0f);
  const Lanes z = s * s;
  const Lanes series = ((z * 0.4121986f + 0.5770780f) * z + 0.9617967f) * z + 2.8853901f;
  return __builtin_convertvector(exponent, Lanes) + s * series;
}

inline float sum(Lanes v) {
  float total = 0.0f;
  for (int i = 0; i < kLanes; ++i) total += v[i];
  return total;
}

inline float largest(Lanes v) {
  float best = v[0];
  for (int i = 1; i < kLanes; ++i) best = v[i] > best ? v[i] : best;
  return best;
}

// Lanes l of `even` and `odd` become the two halves of to[pair_place(l)].
inline void interleave(Lanes even, Lanes odd, double* to) {
#if defined(__AVX512F__)
  const __m512 a = reinterpret_cast<__m512>(even), b = reinterpret_cast<__m512>(odd);
  _mm512_store_ps(reinterpret_cast<float*>(to), _mm512_unpacklo_ps(a, b));
  _mm512_store_ps(reinterpret_cast<float*>(to + 8), _mm512_unpackhi_ps(a, b));
#elif defined(__AVX2__)
  const __m256 a = reinterpret_cast<__m256>(even), b = reinterpret_cast<__m256>(odd);
  _mm256_store_ps(reinterpret_cast<float*>(to), _mm256_unpacklo_ps(a, b));
  _mm256_store_ps(reinterpret_cast<float*>(to + 4), _mm256_unpackhi_ps(a, b));
#else
  alignas(64) float pairs[2 * kLanes];
  for (int l = 0; l < kLanes; ++l) pairs[2 * l] = even[l], pairs[2 * l + 1] = odd[l];
  std::memcpy(to, pairs, sizeof(pairs));
#endif
}

constexpr int pair_place(int l) {
#if defined(__AVX2__)
  return l / 4 * 2 + l % 2 + (l % 4 / 2) * (kLanes / 2);
#else
  return l;
#endif
}

inline Lanes splat_pair(double pair) {
  typedef double Doubles __attribute__((vector_size(sizeof(Lanes))));
  return reinterpret_cast<Lanes>(pair - Doubles{});
}

// A vector in memory and those around it: shifted<d>() is load(at + d) for |d| < kLanes.
struct Neighbours {
#if defined(__AVX512F__)
  __m512i before, here, after;  // three aligned loads and shuffles beat many loads off the line
  explicit Neighbours(const float* at)
      : before(_mm512_loadu_si512(at - 16)), here(_mm512_loadu_si512(at)),
        after(_mm512_loadu_si512(at + 16)) {}
  template <int kBy>
  Lanes shifted() const {
    return reinterpret_cast<Lanes>(kBy < 0 ? _mm512_alignr_epi32(here, before, (16 + kBy) & 15)
                                           : _mm512_alignr_epi32(after, here, kBy & 15));
  }
#else
  const float* at;
  explicit Neighbours(const float* where) : at(where) {}
  template <int kBy>
  Lanes shifted() const {
    return load(at + kBy);
  }
#endif
};

// Row l of `to` becomes lane l of all kLanes vectors.
inline void transpose(const Lanes* from, float* to, size_t stride) {
#if defined(__AVX512F__)
  __m512 a[16], b[16];
  for (int k = 0; k < 16; k += 2) {  // pairs of lanes, within each quarter
    const __m512 even = reinterpret_cast<__m512>(from[k]);
    const __m512 odd = reinterpret_cast<__m512>(from[k + 1]);
    a[k] = _mm512_unpacklo_ps(even, odd);
    a[k + 1] = _mm512_unpackhi_ps(even, odd);
  }
  for (int k = 0; k < 16; k += 4)  // fours
    for (int h = 0; h < 2; ++h) {
      const __m512d one = _mm512_castps_pd(a[k + h]), other = _mm512_castps_pd(a[k + 2 + h]);
      b[k + 2 * h] = _mm512_castpd_ps(_mm512_unpacklo_pd(one, other));
      b[k + 2 * h + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(one, other));
    }
  for (int k = 0; k < 4; ++k) {  // quarters
    const __m512 near_low = _mm512_shuffle_f32x4(b[k], b[4 + k], 0x88);
    const __m512 near_high = _mm512_shuffle_f32x4(b[k], b[4 + k], 0xdd);
    const __m512 far_low = _mm512_shuffle_f32x4(b[8 + k], b[12 + k], 0x88);
    const __m512 far_high = _mm512_shuffle_f32x4(b[8 + k], b[12 + k], 0xdd);
    _mm512_storeu_ps(to + k * stride, _mm512_shuffle_f32x4(near_low, far_low, 0x88));
    _mm512_storeu_ps(to + (8 + k) * stride, _mm512_shuffle_f32x4(near_low, far_low, 0xdd));
    _mm512_storeu_ps(to + (4 + k) * stride, _mm512_shuffle_f32x4(near_high, far_high, 0x88));
    _mm512_storeu_ps(to + (12 + k) * stride, _mm512_shuffle_f32x4(near_high, far_high, 0xdd));
  }
#else
  for (int k = 0; k < kLanes; ++k)
    for (int l = 0; l < kLanes; ++l) to[l * stride + k] = from[k][l];
#endif
}

#if defined(__AVX512F__)
// Element order[t] of the concatenation of up to four vectors becomes lane t.
template <int kCount>
inline Lanes pick(const Lanes* from, const int32_t* order) {
  const __m512i index = _mm512_load_si512(order);
  const auto part = [&](int k) { return reinterpret_cast<__m512>(from[k < kCount ? k : 0]); };
  const __m512 low = _mm512_permutex2var_ps(part(0), index, part(1));
  if (kCount <= 2) return reinterpret_cast<Lanes>(low);
  const __mmask16 is_high = _mm512_cmpge_epi32_mask(index, _mm512_set1_epi32(32));
  const __m512 high = _mm512_permutex2var_ps(part(2), index, part(3));
  return reinterpret_cast<Lanes>(_mm512_mask_blend_ps(is_high, low, high));
}

template <int kColumns>
struct PickOrders {
  alignas(64) int32_t split[kColumns][kLanes], join[kColumns][kLanes];

  constexpr PickOrders() : split(), join() {
    for (int e = 0; e < kColumns * kLanes; ++e) {  // row e / kColumns, column e % kColumns
      split[e % kColumns][e / kColumns] = e;
      join[e / kLanes][e % kLanes] = e % kColumns * kLanes + e / kColumns;
    }
  }
};
template <int kColumns>
inline constexpr PickOrders<kColumns> kPickOrders{};
#endif

// kLanes rows of kColumns <= 4 floats to one vector per column, and back.
template <int kColumns>
inline void split_columns(const float* rows, Lanes* out) {
#if defined(__AVX512F__)
  Lanes in[kColumns];
  for (int k = 0; k < kColumns; ++k) in[k] = load(rows + k * kLanes);
  for (int k = 0; k < kColumns; ++k) out[k] = pick<kColumns>(in, kPickOrders<kColumns>.split[k]);
#else
  alignas(64) float columns[kColumns][kLanes];
  for (int lane = 0; lane < kLanes; ++lane)
    for (int k = 0; k < kColumns; ++k) columns[k][lane] = rows[lane * kColumns + k];
  for (int k = 0; k < kColumns; ++k) out[k] = load(columns[k]);
#endif
}

template <int kColumns>
inline void join_columns(const Lanes* in, float* rows) {
#if defined(__AVX512F__)
  for (int k = 0; k < kColumns; ++k)
    store(rows + k * kLanes, pick<kColumns>(in, kPickOrders<kColumns>.join[k]));
#else
  alignas(64) float columns[kColumns][kLanes];
  for (int k = 0; k < kColumns; ++k) store(columns[k], in[k]);
  for (int lane = 0; lane < kLanes; ++lane)
    for (int k = 0; k < kColumns; ++k) rows[lane * kColumns + k] = columns[k][lane];
#endif
}

// Read rows i .. i + kLanes - 1 of an array [count, kColumns] into one vector per column. The
// tail repeats the last row; callers mask it.
template <int kColumns>
inline void load_rows(const float* array, int i, int count, Lanes* out) {
  const float* row = array + static_cast<size_t>(i) * kColumns;
  if (i + kLanes <= count) return split_columns<kColumns>(row, out);
  alignas(64) float rows[kLanes * kColumns];
  for (int lane = 0; lane < kLanes; ++lane)
    std::memcpy(rows + lane * kColumns, row + std::min(lane, count - 1 - i) * kColumns,
                kColumns * sizeof(float));
  split_columns<kColumns>(rows, out);
}

template <int kColumns>
inline void store_rows(float* array, int i, int count, const Lanes* in) {
  float* row = array + static_cast<size_t>(i) * kColumns;
  if (i + kLanes <= count) return join_columns<kColumns>(in, row);
  alignas(64) float rows[kLanes * kColumns];
  join_columns<kColumns>(in, rows);
  std::memcpy(row, rows, (count - i) * kColumns * sizeof(float));
}

constexpr size_t kHugePage = size_t{1} << 21;

// An array that keeps its memory between calls and starts on a cache line.
template <typename T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  Buffer(Buffer&& other) noexcept { std::swap(data_, other.data_), std::swap(size_, other.size_); }
  ~Buffer() { std::free(data_); }

  // Make room for `size` elements; the first `keep` survive. New memory is zero.
  T* reserve(size_t size, size_t keep = 0) {
    if (size <= size_) return data_;
    const size_t grown = (size + size / 2 + 63) / 64 * 64;
    const size_t bytes = grown * sizeof(T);
    const size_t page = bytes >= kHugePage ? kHugePage : 64;
    const size_t room = (bytes + page - 1) / page * page;
    void* memory = std::aligned_alloc(page, room);
    if (memory == nullptr) throw std::bad_alloc();
#if defined(__linux__)
    if (page == kHugePage) madvise(memory, room, MADV_HUGEPAGE);  // random access: fewer TLB misses
#endif
    std::memset(memory, 0, bytes);
    if (keep > 0) std::memcpy(memory, data_, keep * sizeof(T));
    std::free(data_);
    data_ = static_cast<T*>(memory);
    size_ = grown;
    return data_;
  }

  T* data() { return data_; }
  const T* data() const { return data_; }
  T& operator[](size_t i) { return data_[i]; }
  const T& operator[](size_t i) const { return data_[i]; }

 private:
  T* data_ = nullptr;
  size_t size_ = 0;
};

}  // namespace bdgs
