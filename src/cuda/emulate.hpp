// CUDA on one thread of a CPU, as far as the kernels here use it: so that the tests run the same
// source where there is no card. The threads of a block are fibers that take turns at every
// barrier and exchange; blocks run one after the other. Slow, and right or stuck.

#pragma once

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <numeric>
#include <vector>

#include <ucontext.h>

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __restrict__
#define __shared__ static
#define __launch_bounds__(...)

struct float4 {
  float x, y, z, w;
};
struct uint3_ {
  unsigned x, y, z;
};

inline thread_local uint3_ threadIdx, blockIdx, blockDim, gridDim;

using cudaStream_t = void*;
using cudaError_t = int;
constexpr int cudaSuccess = 0, cudaMemcpyDeviceToHost = 0;

using std::max;
using std::min;

namespace bdgs {

inline void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess) throw std::runtime_error(what);
}

// The fibers of the block that runs.
class Fibers {
 public:
  void run(int threads, const std::function<void()>& body) {
    body_ = &body;
    threads_ = alive_ = threads;
    arrived_ = generation_ = 0;
    flag_ = result_ = false;
    warp_arrived_.assign(threads / 32 + 1, 0);
    warp_generation_.assign(threads / 32 + 1, 0);
    exchanged_.assign(threads, 0.0f);
    contexts_.resize(threads);
    stacks_.resize(threads);
    done_.assign(threads, 0);
    for (int t = 0; t < threads; ++t) start(t);
    while (alive_ > 0)
      for (int t = 0; t < threads; ++t)
        if (!done_[t]) {
          current_ = t;
          threadIdx.x = t;
          swapcontext(&main_, &contexts_[t]);
        }
  }

  bool barrier(bool flag, bool all) {
    if (arrived_ == 0) flag_ = all;
    flag_ = all ? (flag_ && flag) : (flag_ || flag);
    const int generation = generation_;
    if (++arrived_ == threads_) {
      arrived_ = 0;
      result_ = flag_;
      ++generation_;
    }
    while (generation == generation_) yield();
    return result_;
  }

  float exchange(float value, int lane_mask) {
    const int me = current_;
    exchanged_[me] = value;
    warp_barrier();
    const float got = exchanged_[me ^ lane_mask];
    warp_barrier();
    return got;
  }

  bool any(bool value) {
    const int me = current_;
    exchanged_[me] = value;
    warp_barrier();
    const int first = me / 32 * 32, last = std::min(first + 32, threads_);
    bool found = false;
    for (int t = first; t < last; ++t) found = found || exchanged_[t] != 0.0f;
    warp_barrier();
    return found;
  }

 private:
  void start(int t) {
    stacks_[t].resize(128 << 10);
    getcontext(&contexts_[t]);
    contexts_[t].uc_stack.ss_sp = stacks_[t].data();
    contexts_[t].uc_stack.ss_size = stacks_[t].size();
    contexts_[t].uc_link = &main_;
    makecontext(&contexts_[t], reinterpret_cast<void (*)()>(&Fibers::enter), 0);
  }

  static void enter();

  void yield() {
    const int me = current_;
    swapcontext(&contexts_[me], &main_);
    current_ = me;
    threadIdx.x = me;
  }

  void warp_barrier() {
    const int warp = current_ / 32, size = std::min(32, threads_ - 32 * warp);
    const int generation = warp_generation_[warp];
    if (++warp_arrived_[warp] == size) {
      warp_arrived_[warp] = 0;
      ++warp_generation_[warp];
    }
    while (generation == warp_generation_[warp]) yield();
  }

  const std::function<void()>* body_ = nullptr;
  int threads_ = 0, alive_ = 0, current_ = 0, arrived_ = 0, generation_ = 0;
  bool flag_ = false, result_ = false;
  std::vector<int> warp_arrived_, warp_generation_;
  std::vector<float> exchanged_;
  std::vector<ucontext_t> contexts_;
  std::vector<std::vector<char>> stacks_;
  std::vector<char> done_;
  ucontext_t main_;
};

inline thread_local Fibers fibers;

inline void Fibers::enter() {
  (*fibers.body_)();
  fibers.done_[fibers.current_] = 1;
  --fibers.alive_;
}

template <typename Kernel, typename... Arguments>
void launch(Kernel kernel, unsigned blocks, unsigned threads, Arguments... arguments) {
  blockDim = {threads, 1, 1};
  gridDim = {blocks, 1, 1};
  for (unsigned block = 0; block < blocks; ++block) {
    blockIdx = {block, 0, 0};
    fibers.run(static_cast<int>(threads), [&] { kernel(arguments...); });
  }
}

}  // namespace bdgs

#define BDGS_LAUNCH(kernel, blocks, threads, stream, ...) \
  bdgs::launch(kernel, (blocks), (threads), __VA_ARGS__)

inline void __syncthreads() { bdgs::fibers.barrier(true, true); }
inline bool __syncthreads_and(bool flag) { return bdgs::fibers.barrier(flag, true); }
inline float __shfl_xor_sync(unsigned, float value, int lane_mask) {
  return bdgs::fibers.exchange(value, lane_mask);
}
inline bool __any_sync(unsigned, bool value) { return bdgs::fibers.any(value); }
inline unsigned __float_as_uint(float v) {
  unsigned bits;
  std::memcpy(&bits, &v, sizeof(bits));
  return bits;
}

inline cudaError_t cudaMalloc(void** data, size_t bytes) {
  *data = std::malloc(bytes);
  return *data == nullptr;
}
inline cudaError_t cudaFree(void* data) {
  std::free(data);
  return cudaSuccess;
}
inline cudaError_t cudaMallocHost(void** data, size_t bytes) { return cudaMalloc(data, bytes); }
inline cudaError_t cudaFreeHost(void* data) { return cudaFree(data); }
inline cudaError_t cudaMemsetAsync(void* data, int value, size_t bytes, cudaStream_t) {
  std::memset(data, value, bytes);
  return cudaSuccess;
}
inline cudaError_t cudaMemcpyAsync(void* to, const void* from, size_t bytes, int, cudaStream_t) {
  std::memcpy(to, from, bytes);
  return cudaSuccess;
}
inline cudaError_t cudaStreamSynchronize(cudaStream_t) { return cudaSuccess; }

// The parts of CUB that are used, with its habit of being asked for memory first.
namespace cub {

struct DeviceRadixSort {
  static cudaError_t SortPairs(void* room, size_t& bytes, const uint32_t* keys, uint32_t* keys_out,
                               const uint32_t* values, uint32_t* values_out, int count, int begin,
                               int end, cudaStream_t) {
    bytes = 1;
    if (room == nullptr) return cudaSuccess;
    std::vector<int> order(count);
    std::iota(order.begin(), order.end(), 0);
    const uint32_t mask = end < 32 ? (1u << end) - 1 : ~0u;
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) {
      return (keys[a] & mask) >> begin < (keys[b] & mask) >> begin;
    });
    for (int k = 0; k < count; ++k) {
      keys_out[k] = keys[order[k]];
      values_out[k] = values[order[k]];
    }
    return cudaSuccess;
  }
};

struct DeviceScan {
  static cudaError_t ExclusiveSum(void* room, size_t& bytes, const uint32_t* in, uint32_t* out,
                                  int count, cudaStream_t) {
    bytes = 1;
    if (room == nullptr) return cudaSuccess;
    uint32_t sum = 0;
    for (int k = 0; k < count; ++k) {
      const uint32_t here = in[k];
      out[k] = sum;
      sum += here;
    }
    return cudaSuccess;
  }
};

}  // namespace cub
