// The loss of one view and its gradient by the rendered planes: ../rasterizer_loss.hpp, which
// explains it, one pixel per thread.

#pragma once

#include "blend.cuh"

namespace bdgs {

constexpr int kRadius = 5, kSpan = kTile + 2 * kRadius;  // of the SSIM window; of what a tile needs
constexpr int kWeightBlocks = 64;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
constexpr float kFar = 1e30f;  // infinite depth is no depth
constexpr float kEdge = 10.0f;
constexpr int kFields = 9;

// What the view should look like. Colour is given as floats, or as the camera's bytes with a scale
// for every pixel; weight as floats, or as bytes that are 0 or not.
struct Target {
  const float* color;
  const uint8_t* image;
  const float* scale;
  const float* depth;
  const float* weight;
  const uint8_t* still;
  int stride;  // pixels from row to row: a window of a larger image

  __device__ size_t at(int y, int x) const { return static_cast<size_t>(y) * stride + x; }
  __device__ float weight_at(size_t p) const {
    if (still != nullptr) return still[p] != 0 ? 1.0f : 0.0f;
    return fmaxf(weight[p], 0.0f);
  }
  __device__ float color_at(size_t p, int c) const {
    return image != nullptr ? image[3 * p + c] * scale[p] : color[3 * p + c];
  }
  __device__ float depth_at(size_t p) const {
    const float d = depth[p];
    return d > 0.0f && d < kFar ? d : 0.0f;
  }
};

struct LossWeights {
  float l1, ssim, depth, smooth, empty;
};

struct Window {  // of a Gaussian, half of it
  float w[kRadius + 1];

  Window() {
    double sum = 0;
    for (int d = -kRadius; d <= kRadius; ++d) sum += std::exp(-d * d / 4.5);
    for (int d = 0; d <= kRadius; ++d) w[d] = static_cast<float>(std::exp(-d * d / 4.5) / sum);
  }
};

enum LossSum { kLossL1, kLossSsim, kLossDepth, kLossSmooth, kLossEmpty, kByGain, kByOffset,
               kLossSums };

// Partial sums of the weights: all, and where depth is known.
__global__ void __launch_bounds__(kTilePixels)
    weights_kernel(Target target, int width, int height, double* partial) {
  double sums[2] = {};
  const int stride = gridDim.x * blockDim.x, pixels = width * height;
  for (int k = blockIdx.x * blockDim.x + threadIdx.x; k < pixels; k += stride) {
    const size_t p = target.at(k / width, k % width);
    const float w = target.weight_at(p);
    sums[0] += w;
    if (w > 0.0f && target.depth_at(p) > 0.0f) sums[1] += w;
  }
  block_sums<2, kTilePixels>(sums, partial + 2 * blockIdx.x);
}

__global__ void scales_kernel(const double* partial, float* per_weight) {
  if (threadIdx.x >= 2) return;
  double sum = 0;
  for (int block = 0; block < kWeightBlocks; ++block) sum += partial[2 * block + threadIdx.x];
  per_weight[threadIdx.x] = sum > 0 ? static_cast<float>(1.0 / sum) : 0.0f;
}

struct LossInput {
  Target target;
  Camera camera;
  Planes rendered;
  const double* exposure;   // log gain, offset
  const float* per_weight;  // 1 / sum of weights: all, and where depth is known
  LossWeights weights;
  Window window;
  int tiles_x;
};

struct Spot {  // the pixel of a thread
  int x, y, left, top;
  bool inside;

  __device__ explicit Spot(const LossInput& in) {
    left = kTile * (blockIdx.x % in.tiles_x);
    top = kTile * (blockIdx.x / in.tiles_x);
    x = left + threadIdx.x % kTile;
    y = top + threadIdx.x / kTile;
    inside = x < in.camera.width && y < in.camera.height;
  }
};

// Blur what `kCount` fields of a tile and its surroundings give, along and then down.
template <int kCount>
struct Blur {
  float fields[kCount][kSpan][kSpan];
  float rows[kCount][kSpan][kTile];

  __device__ void along(const Window& window) {
    for (int k = threadIdx.x; k < kSpan * kTile; k += kTilePixels) {
      const int y = k / kTile, x = k % kTile + kRadius;
      for (int f = 0; f < kCount; ++f) {
        float sum = window.w[0] * fields[f][y][x];
        for (int d = 1; d <= kRadius; ++d)
          sum += window.w[d] * (fields[f][y][x - d] + fields[f][y][x + d]);
        rows[f][y][x - kRadius] = sum;
      }
    }
  }
  __device__ float down(const Window& window, int f) const {
    const int y = threadIdx.x / kTile + kRadius, x = threadIdx.x % kTile;
    float sum = window.w[0] * rows[f][y][x];
    for (int d = 1; d <= kRadius; ++d)
      sum += window.w[d] * (rows[f][y - d][x] + rows[f][y + d][x]);
    return sum;
  }
};

// SSIM of every pixel, and the nine fields whose blurred sums are its gradient.
__global__ void __launch_bounds__(kTilePixels)
    ssim_kernel(LossInput in, float* fields, double* partial) {
  __shared__ Blur<5> blur;  // mask, x, y, x^2 + y^2, x y
  const Spot spot(in);
  const float gain = expf(static_cast<float>(in.exposure[0]));
  const float offset = static_cast<float>(in.exposure[1]);
  const size_t size = in.rendered.size;
  const size_t here = static_cast<size_t>(spot.y) * in.camera.width + spot.x;
  const float w = spot.inside ? in.target.weight_at(in.target.at(spot.y, spot.x)) : 0.0f;
  const float scale = in.weights.ssim * in.per_weight[0] / 3.0f;
  float loss = 0;
  for (int c = 0; c < 3; ++c) {
    __syncthreads();
    for (int k = threadIdx.x; k < kSpan * kSpan; k += kTilePixels) {
      const int row = k / kSpan, column = k % kSpan;
      const int y = spot.top + row - kRadius, x = spot.left + column - kRadius;
      float mask = 0, v = 0, t = 0;
      if (x >= 0 && y >= 0 && x < in.camera.width && y < in.camera.height) {
        const size_t p = in.target.at(y, x);
        if (in.target.weight_at(p) > 0.0f) {
          mask = 1;
          v = gain * in.rendered.at(c)[static_cast<size_t>(y) * in.camera.width + x] + offset;
          t = in.target.color_at(p, c);
        }
      }
      const float values[5] = {mask, v, t, v * v + t * t, v * t};
      for (int f = 0; f < 5; ++f) blur.fields[f][row][column] = values[f];
    }
    __syncthreads();
    blur.along(in.window);
    __syncthreads();
    if (!spot.inside) continue;
    const float per_n = 1.0f / fmaxf(blur.down(in.window, 0), 1e-6f);
    const float mx = per_n * blur.down(in.window, 1), my = per_n * blur.down(in.window, 2);
    const float ss = per_n * blur.down(in.window, 3), cc = per_n * blur.down(in.window, 4);
    const float a1 = 2.0f * mx * my + kC1, a2 = 2.0f * (cc - mx * my) + kC2;
    const float mm = mx * mx + my * my;
    const float per_b1 = 1.0f / (mm + kC1), per_b2 = 1.0f / (fmaxf(ss - mm, 0.0f) + kC2);
    const float per_b = per_b1 * per_b2, f = a1 * a2 * per_b, g = -scale * w * per_n;
    const float f_m = 2.0f * (my * (a2 - a1) * per_b + mx * f * (per_b2 - per_b1));
    fields[c * size + here] = g * f_m;
    fields[(3 + c) * size + here] = -g * f * per_b2;
    fields[(6 + c) * size + here] = 2.0f * g * a1 * per_b;
    loss += w * (1.0f - f);
  }
  const double sums[1] = {loss / 3.0};
  block_sums<1, kTilePixels>(sums, partial + blockIdx.x);
}

// Mean depth that the map shows, where it counts for smoothness; else 0.
__device__ inline float shown_depth(const LossInput& in, int y, int x) {
  if (x < 0 || y < 0 || x >= in.camera.width || y >= in.camera.height) return 0.0f;
  const size_t p = static_cast<size_t>(y) * in.camera.width + x;
  const float silhouette = in.rendered.at(kPlaneSilhouette)[p];
  const bool counts = silhouette > 0.5f && in.target.weight_at(in.target.at(y, x)) > 0.0f;
  return counts ? fmaxf(in.rendered.at(kPlaneDepth)[p] / silhouette, 0.0f) : 0.0f;
}

struct Bend {
  float loss = 0, slope = 0;  // w e r of a triple, and its derivative by the middle depth
};

__device__ inline Bend bend(const LossInput& in, int y, int x, int dy, int dx) {
  Bend out;
  const float before = shown_depth(in, y - dy, x - dx), middle = shown_depth(in, y, x),
              after = shown_depth(in, y + dy, x + dx);
  if (!(before > 0.0f && middle > 0.0f && after > 0.0f)) return out;
  const size_t p = in.target.at(y, x), p0 = in.target.at(y - dy, x - dx),
               p1 = in.target.at(y + dy, x + dx);
  float edge = 0;
  for (int c = 0; c < 3; ++c) {
    const float t = in.target.color_at(p, c);
    const float one = t - in.target.color_at(p0, c), other = t - in.target.color_at(p1, c);
    edge += one * one + other * other;
  }
  const float weight =
      exp2f(fmaxf(edge * (-kEdge / 3.0f * kLog2E), -100.0f)) * in.target.weight_at(p);
  const float r = middle - 2.0f * before * after / fmaxf(before + after, 1e-6f);
  out.loss = weight * fabsf(r);
  const float sign = r > 0.0f ? 1.0f : (r < 0.0f ? -1.0f : 0.0f);
  out.slope = in.weights.smooth * in.per_weight[0] * weight * sign;
  return out;
}

// dL/d(mean depth) of a pixel from the three triples along (dy, dx) that it is part of.
__device__ inline float bend_backward(const LossInput& in, int y, int x, int dy, int dx,
                                      float* loss) {
  const Bend own = bend(in, y, x, dy, dx);
  const float middle = shown_depth(in, y, x);
  *loss += own.loss;
  float sum = own.slope;
  for (int side = -1; side <= 1; side += 2) {
    const float slope = bend(in, y + side * dy, x + side * dx, dy, dx).slope;
    if (slope == 0.0f) continue;
    const float far = shown_depth(in, y + 2 * side * dy, x + 2 * side * dx);
    const float share = far / fmaxf(middle + far, 1e-6f);
    sum -= 2.0f * slope * share * share;
  }
  return sum;
}

__device__ inline float sign_of(float v) { return v > 0.0f ? 1.0f : (v < 0.0f ? -1.0f : 0.0f); }

// dL/d of the five rendered planes; sums of the terms but SSIM's, and by the exposure.
__global__ void __launch_bounds__(kTilePixels)
    loss_kernel(LossInput in, const float* fields, Planes gradient, double* partial) {
  __shared__ Blur<3> blur;
  const Spot spot(in);
  const float gain = expf(static_cast<float>(in.exposure[0]));
  const float offset = static_cast<float>(in.exposure[1]);
  const size_t size = in.rendered.size;
  const size_t here = static_cast<size_t>(spot.y) * in.camera.width + spot.x;
  const size_t p = spot.inside ? in.target.at(spot.y, spot.x) : 0;
  const float w = spot.inside ? in.target.weight_at(p) : 0.0f;
  double sums[kLossSums] = {};
  for (int c = 0; c < 3; ++c) {
    __syncthreads();
    for (int k = threadIdx.x; k < kSpan * kSpan; k += kTilePixels) {
      const int row = k / kSpan, column = k % kSpan;
      const int y = spot.top + row - kRadius, x = spot.left + column - kRadius;
      const bool inside = x >= 0 && y >= 0 && x < in.camera.width && y < in.camera.height;
      const size_t from = static_cast<size_t>(y) * in.camera.width + x;
      for (int f = 0; f < 3; ++f)
        blur.fields[f][row][column] = inside ? fields[(3 * f + c) * size + from] : 0.0f;
    }
    __syncthreads();
    blur.along(in.window);
    __syncthreads();
    if (!spot.inside) continue;
    const float shown = gain * in.rendered.at(c)[here], v = shown + offset;
    float g = 0;
    if (w > 0.0f) {
      const float t = in.target.color_at(p, c);
      g = in.weights.l1 * in.per_weight[0] / 3.0f * w * sign_of(v - t) +
          blur.down(in.window, 0) + 2.0f * v * blur.down(in.window, 1) +
          t * blur.down(in.window, 2);
      sums[kLossL1] += w * fabsf(v - t) / 3.0;
    }
    sums[kByOffset] += g;
    sums[kByGain] += g * shown;
    gradient.at(c)[here] = g * gain;
  }
  if (spot.inside) {
    const float z = in.rendered.at(kPlaneDepth)[here];
    const float silhouette = in.rendered.at(kPlaneSilhouette)[here];
    const float d = in.target.depth_at(p), use = d > 0.0f ? w : 0.0f, error = z - silhouette * d;
    float by_depth = in.weights.depth * in.per_weight[1] * use * sign_of(error);
    float by_silhouette = -by_depth * z / fmaxf(silhouette, 1e-6f) -
                          in.weights.empty * in.per_weight[1] * use;
    sums[kLossDepth] = use * fabsf(error);
    sums[kLossEmpty] = use * (1.0f - silhouette);
    if (in.weights.smooth > 0.0f) {
      float loss = 0;
      const float by_mean = bend_backward(in, spot.y, spot.x, 0, 1, &loss) +
                            bend_backward(in, spot.y, spot.x, 1, 0, &loss);
      const float through = by_mean / fmaxf(silhouette, 0.5f);
      by_depth += through;
      by_silhouette -= through * shown_depth(in, spot.y, spot.x);
      sums[kLossSmooth] = loss;
    }
    gradient.at(kPlaneDepth)[here] = by_depth;
    gradient.at(kPlaneSilhouette)[here] = by_silhouette;
  }
  block_sums<kLossSums, kTilePixels>(sums, partial + kLossSums * static_cast<size_t>(blockIdx.x));
}

}  // namespace bdgs
