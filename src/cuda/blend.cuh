// Blending front to back, and the way back: the method of ../rasterizer.cpp, one tile per block,
// one pixel per thread.
//
// A warp has 8 x 4 pixels, and passes over the Gaussians whose boxes it does not touch. Going back,
// it sums what its pixels say about a Gaussian by exchanges between lanes, the warps of the tile
// are added in a fixed order, and the sums go to the Gaussian's slot of this tile.

#pragma once

#include "tiles.cuh"

namespace bdgs {

constexpr int kWarps = kTilePixels / kWarp;
constexpr int kForwardBatch = kTilePixels / 4, kBackwardBatch = 32;

struct Planes {  // [6, H, W]: red, green, blue, depth, silhouette, dynamic
  float* data;
  size_t size;

  __device__ float* at(int plane) const { return data + plane * size; }
};

enum Plane { kPlaneDepth = 3, kPlaneSilhouette, kPlaneDynamic, kPlanes };

struct Pixel {
  int x, y, block_x, block_y;  // block: of the warp
  bool inside;

  __device__ Pixel(const Camera& camera, int tiles_x) {
    const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
    block_x = kTile * (blockIdx.x % tiles_x) + 8 * (warp % 2);
    block_y = kTile * (blockIdx.x / tiles_x) + 4 * (warp / 2);
    x = block_x + lane % 8;
    y = block_y + lane / 8;
    inside = x < camera.width && y < camera.height;
  }
  __device__ bool touched_by(const Record& r) const {  // the same for all of the warp
    const Box box = box_of(r);
    return box.x0 < block_x + 8 && box.x1 >= block_x && box.y0 < block_y + 4 && box.y1 >= block_y;
  }
};

__device__ inline float alpha_at(const Record& r, float dx, float dy) {
  const float alpha = exp2f(r.l + r.a * dx * dx + r.b * dx * dy + r.c * dy * dy);
  return alpha >= kMinAlpha ? fminf(alpha, kMaxAlpha) : 0.0f;
}

// Four threads copy a record; the first `4 kBatch` of the block are at work.
template <int kBatch>
__device__ inline void load_batch(const Tiles& tiles, uint32_t begin, uint32_t end,
                                  Record* records, uint32_t* slots) {
  const uint32_t j = threadIdx.x / 4, part = threadIdx.x % 4;
  if (j >= kBatch || begin + j >= end) return;
  const uint32_t slot = tiles.slots[begin + j];
  const Record* from = tiles.records + tiles.slot_gaussian[slot];
  reinterpret_cast<float4*>(records + j)[part] = reinterpret_cast<const float4*>(from)[part];
  if (part == 0 && slots != nullptr) slots[j] = slot;
}

__global__ void __launch_bounds__(kTilePixels)
    forward_kernel(Tiles tiles, Camera camera, Planes out) {
  __shared__ Record records[kForwardBatch];
  const Pixel pixel(camera, tiles.tiles_x);
  const Range range = tiles.ranges[blockIdx.x];
  float T = 1, red = 0, green = 0, blue = 0, depth = 0, silhouette = 0, dynamic = 0;
  bool done = !pixel.inside;
  for (uint32_t begin = range.begin; begin < range.end; begin += kForwardBatch) {
    if (__syncthreads_and(done)) break;
    load_batch<kForwardBatch>(tiles, begin, range.end, records, nullptr);
    __syncthreads();
    const int count = min(static_cast<uint32_t>(kForwardBatch), range.end - begin);
    for (int j = 0; j < count && !done; ++j) {
      const Record& r = records[j];
      if (!pixel.touched_by(r)) continue;
      const float dx = pixel.x - r.u, dy = pixel.y - r.v;
      const float w = alpha_at(r, dx, dy) * T;
      if (w == 0.0f) continue;
      red += w * r.red;
      green += w * r.green;
      blue += w * r.blue;
      depth += w * (r.z + r.zeta_u * dx + r.zeta_v * dy);
      silhouette += w;
      dynamic += w * r.p_dynamic;
      T -= w;
      done = T < kMinTransmittance;
    }
  }
  if (!pixel.inside) return;
  const size_t at = static_cast<size_t>(pixel.y) * camera.width + pixel.x;
  const float values[kPlanes] = {red, green, blue, depth, silhouette, dynamic};
  for (int k = 0; k < kPlanes; ++k) out.at(k)[at] = values[k];
}

// Sums of every slot over the warps of its tile, and zeros for the slots that nobody came to.
template <int kColumns>
__device__ inline void store_sums(const float (*sums)[kBackwardBatch][kColumns],
                                  const uint32_t* slots, int count, float* slot_sums) {
  for (int k = threadIdx.x; k < count * kColumns; k += kTilePixels) {
    const int j = k / kColumns, column = k % kColumns;
    float total = 0;
    for (int warp = 0; warp < kWarps; ++warp) total += sums[warp][j][column];
    slot_sums[static_cast<size_t>(slots[j]) * kColumns + column] = total;
  }
}

template <int kColumns>
__device__ inline void clear_slots(const Tiles& tiles, uint32_t begin, uint32_t end,
                                   float* slot_sums) {
  for (uint32_t k = threadIdx.x; k < (end - begin) * kColumns; k += kTilePixels)
    slot_sums[static_cast<size_t>(tiles.slots[begin + k / kColumns]) * kColumns + k % kColumns] =
        0.0f;
}

// `rendered` as the forward pass left it, and dL/d of its first five planes.
__global__ void __launch_bounds__(kTilePixels)
    backward_kernel(Tiles tiles, Camera camera, Planes rendered, Planes gradient,
                    float* slot_sums) {
  __shared__ Record records[kBackwardBatch];
  __shared__ uint32_t slots[kBackwardBatch];
  __shared__ float sums[kWarps][kBackwardBatch][kSums];
  const Pixel pixel(camera, tiles.tiles_x);
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const Range range = tiles.ranges[blockIdx.x];
  float d[5] = {}, rest = 0, T = 1;
  if (pixel.inside) {
    const size_t at = static_cast<size_t>(pixel.y) * camera.width + pixel.x;
    for (int k = 0; k < 5; ++k) {
      d[k] = gradient.at(k)[at];
      rest += d[k] * rendered.at(k)[at];
    }
  }
  bool done = !pixel.inside;
  uint32_t begin = range.begin;
  for (; begin < range.end; begin += kBackwardBatch) {
    if (__syncthreads_and(done)) break;
    load_batch<kBackwardBatch>(tiles, begin, range.end, records, slots);
    __syncthreads();
    const int count = min(static_cast<uint32_t>(kBackwardBatch), range.end - begin);
    for (int j = 0; j < count; ++j) {
      const Record& r = records[j];
      const float dx = pixel.x - r.u, dy = pixel.y - r.v;
      float alpha = 0;
      if (!done && pixel.touched_by(r)) alpha = alpha_at(r, dx, dy);
      if (!__any_sync(kAllLanes, alpha > 0.0f)) {
        if (lane % 2 == 0) sums[warp][j][lane / 2] = 0.0f;
        continue;
      }
      float v[kSums] = {};
      if (alpha > 0.0f) {
        const float w = alpha * T;
        const float u = d[0] * r.red + d[1] * r.green + d[2] * r.blue +
                        d[3] * (r.z + r.zeta_u * dx + r.zeta_v * dy) + d[4];
        rest -= w * u;
        // g = alpha dL/dalpha; a clamped alpha does not move with the Gaussian
        const float g = alpha < kMaxAlpha ? w * u - alpha * rest / (1.0f - alpha) : 0.0f;
        T -= w;
        done = T < kMinTransmittance;
        v[kG] = g;
        v[kGx] = g * dx;
        v[kGy] = g * dy;
        v[kGxx] = g * dx * dx;
        v[kGxy] = g * dx * dy;
        v[kGyy] = g * dy * dy;
        v[kRed] = w * d[0];
        v[kGreen] = w * d[1];
        v[kBlue] = w * d[2];
        v[kSumDepth] = w * d[3];
        v[kSumDepthX] = w * d[3] * dx;
        v[kSumDepthY] = w * d[3] * dy;
        v[kSumWeight] = w;
      }
      const float total = warp_sums(v);
      if (lane % 2 == 0) sums[warp][j][lane / 2] = total;
    }
    __syncthreads();
    store_sums<kSums>(sums, slots, count, slot_sums);
  }
  clear_slots<kSums>(tiles, min(begin, range.end), range.end, slot_sums);
}

// Sum and maximum of the weights of every slot, of each of the warps' in turn.
__global__ void __launch_bounds__(kTilePixels)
    statistics_kernel(Tiles tiles, Camera camera, float* slot_sums) {
  __shared__ Record records[kBackwardBatch];
  __shared__ uint32_t slots[kBackwardBatch];
  __shared__ float sums[kWarps][kBackwardBatch][2];
  const Pixel pixel(camera, tiles.tiles_x);
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const Range range = tiles.ranges[blockIdx.x];
  float T = 1;
  bool done = !pixel.inside;
  uint32_t begin = range.begin;
  for (; begin < range.end; begin += kBackwardBatch) {
    if (__syncthreads_and(done)) break;
    load_batch<kBackwardBatch>(tiles, begin, range.end, records, slots);
    __syncthreads();
    const int count = min(static_cast<uint32_t>(kBackwardBatch), range.end - begin);
    for (int j = 0; j < count; ++j) {
      const Record& r = records[j];
      float w = 0;
      if (!done && pixel.touched_by(r)) w = alpha_at(r, pixel.x - r.u, pixel.y - r.v) * T;
      T -= w;
      done = done || T < kMinTransmittance;
      float largest = w;
      if (__any_sync(kAllLanes, w > 0.0f))
        for (int other = kWarp / 2; other > 0; other /= 2) {
          w += __shfl_xor_sync(kAllLanes, w, other);
          largest = fmaxf(largest, __shfl_xor_sync(kAllLanes, largest, other));
        }
      if (lane == 0) {
        sums[warp][j][0] = w;
        sums[warp][j][1] = largest;
      }
    }
    __syncthreads();
    for (int j = threadIdx.x; j < count; j += kTilePixels) {
      float total = 0, largest = 0;
      for (int k = 0; k < kWarps; ++k) {
        total += sums[k][j][0];
        largest = fmaxf(largest, sums[k][j][1]);
      }
      slot_sums[2 * static_cast<size_t>(slots[j])] = total;
      slot_sums[2 * static_cast<size_t>(slots[j]) + 1] = largest;
    }
  }
  clear_slots<2>(tiles, min(begin, range.end), range.end, slot_sums);
}

// Sums of a Gaussian over its slots: one thread per column.
__global__ void gather_kernel(int count, const uint32_t* firsts, const uint32_t* tiles,
                              const float* slot_sums, float* out) {
  const size_t k = static_cast<size_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  const size_t i = k / kSums, column = k % kSums;
  if (i >= static_cast<size_t>(count)) return;
  const uint32_t first = firsts[i], last = first + tiles[i];
  float total = 0;
  for (uint32_t slot = first; slot < last; ++slot)
    total += slot_sums[static_cast<size_t>(slot) * kSums + column];
  out[k] = total;
}

__global__ void gather_statistics_kernel(int count, const uint32_t* firsts, const uint32_t* tiles,
                                         const float* slot_sums, float* visibility,
                                         float* max_weight) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= count) return;
  const uint32_t first = firsts[i], last = first + tiles[i];
  float total = 0, largest = 0;
  for (uint32_t slot = first; slot < last; ++slot) {
    total += slot_sums[2 * static_cast<size_t>(slot)];
    largest = fmaxf(largest, slot_sums[2 * static_cast<size_t>(slot) + 1]);
  }
  visibility[i] = total;
  max_weight[i] = largest;
}

}  // namespace bdgs
