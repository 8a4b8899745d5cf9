// What the kernels need of their platform: CUDA, or its emulation on a CPU for the tests.

#pragma once

#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <string>

#ifdef __CUDACC__

#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
#include <cuda_runtime.h>

#define BDGS_LAUNCH(kernel, blocks, threads, stream, ...)             \
  do {                                                                \
    kernel<<<(blocks), (threads), 0, (stream)>>>(__VA_ARGS__);        \
    bdgs::check(cudaGetLastError(), #kernel);                         \
  } while (0)

namespace bdgs {

inline void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess)
    throw std::runtime_error(std::string(what) + ": " + cudaGetErrorString(status));
}

}  // namespace bdgs

#else
#include "emulate.hpp"
#endif

namespace bdgs {

constexpr int kWarp = 32;
constexpr unsigned kAllLanes = 0xffffffffu;

// Memory of the device that grows and is kept between calls.
template <typename T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() {
    if (data_ != nullptr) cudaFree(data_);
  }

  // Room for `count`; what was there is lost if it has to move.
  T* reserve(size_t count) {
    if (count > capacity_) {
      if (data_ != nullptr) check(cudaFree(data_), "cudaFree");
      data_ = nullptr;
      capacity_ = count + count / 2;
      check(cudaMalloc(reinterpret_cast<void**>(&data_), capacity_ * sizeof(T)),
            "memory of the device");
    }
    return data_;
  }
  T* data() const { return data_; }
  size_t bytes() const { return capacity_ * sizeof(T); }

 private:
  T* data_ = nullptr;
  size_t capacity_ = 0;
};

// Lane `l` gets, summed over the warp, value number l / 2: 16 exchanges for 16 sums, where one
// sum after the other takes 80. Halves of the values change sides, then quarters, ...
__device__ inline float warp_sums(float (&v)[16]) {
  const int lane = threadIdx.x % kWarp;
#pragma unroll
  for (int half = 8; half > 0; half /= 2) {
    const bool upper = lane & (2 * half);
#pragma unroll
    for (int k = 0; k < half; ++k) {
      const float sent = upper ? v[k] : v[k + half], kept = upper ? v[k + half] : v[k];
      v[k] = kept + __shfl_xor_sync(kAllLanes, sent, 2 * half);
    }
  }
  return v[0] + __shfl_xor_sync(kAllLanes, v[0], 1);
}

// Sum kColumns values over the block, in a fixed order; thread 0 writes them to `out`.
template <int kColumns, int kThreads>
__device__ inline void block_sums(const double (&values)[kColumns], double* out) {
  __shared__ double shared[kColumns][kThreads];
  const int t = threadIdx.x;
  for (int k = 0; k < kColumns; ++k) shared[k][t] = values[k];
  __syncthreads();
  for (int half = kThreads / 2; half > 0; half /= 2) {
    if (t < half)
      for (int k = 0; k < kColumns; ++k) shared[k][t] += shared[k][t + half];
    __syncthreads();
  }
  if (t < kColumns) out[t] = shared[t][0];
}

}  // namespace bdgs
