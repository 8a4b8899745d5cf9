// The loss of one view and its gradient with respect to the rendered planes.
//
//   I   = exp(log_gain) C + offset                        exposure of the target, C rendered
//   E   = sum_p w_p [ l1 |I - T|_p + ssim (1 - SSIM_p) ] / sum_p w_p
//       + depth  sum_{p: D_p > 0} w_p |Z - S D|_p / sum_{p: D_p > 0} w_p
//       + smooth sum_p w_p (e_p^h r_p^h + e_p^v r_p^v) / sum_p w_p
//
// |.| and SSIM are means over the three channels. Z = sum of weights times depth and S = silhouette,
// so Z - S D = sum of weights times (z - D): it needs no division by S, is zero where nothing was
// drawn, and pulls each Gaussian by its own weight. (Z / S - D instead grows without bound at the
// rim of the map, where S goes to 0.)
//
// The last term is the edge-aware smoothness that stands for the image-gradient term of Eq. 8, after
// `depth_reg` of MonoGS (Matsuki et al., 2024): there e |dZ| with e = exp(-10 |grad T|^2). A first
// difference would turn every wall towards the camera, so here r compares a pixel's mean depth z = Z/S
// with that of the line through its two neighbours, along the row (h) and the column (v):
//   r = |z - 2 z_- z_+ / (z_- + z_+)|      0 on any plane, because 1/z is affine in the image
//   e = exp(-10 (|T - T_-|^2 + |T - T_+|^2)) with means over the channels
// and counts only if all three pixels have w > 0 and S > 0.5: a hole is not a cliff.
//
// SSIM uses the usual 11 x 11 window, sigma 1.5 px, and constants for images in [0, 1]. The window
// is cut to the pixels with w > 0 inside the image and normalised over them, so what a moving
// object hides is in nobody's statistics. With n, mx, my, s, c the windowed sums of 1, x, y,
// x^2 + y^2 and x y over those pixels, SSIM is a function f(mx/n, s/n, c/n), and the gradient with
// respect to x is three more windows: blur(f_m/n) + 2 x blur(f_s/n) + y blur(f_c/n).

#pragma once

#include <algorithm>

#include "rasterizer_simd.hpp"

namespace bdgs {

// All planes share one layout with a border of zeros: SSIM windows and vectors may overhang.
struct Layout {
  static constexpr int kBorder = 16;
  int width = 0, height = 0;
  size_t stride = 0, plane = 0;

  Layout() = default;
  Layout(int w, int h) : width(w), height(h) {
    stride = (w + 15) / 16 * 16 + 2 * kBorder;
    if (stride % 256 == 0) stride += 16;  // rows 1 KiB apart fall into the same cache sets
    plane = stride * ((h + 15) / 16 * 16 + 2 * kBorder) + 16;
  }
  size_t at(int y, int x) const { return (y + kBorder) * stride + kBorder + x; }
};

enum Plane {
  kRed, kGreen, kBlue, kDepth, kSilhouette, kDynamic,  // rendered
  kGradRed, kGradGreen, kGradBlue, kGradDepth, kGradSilhouette,
  kWeight, kMask,           // w and w > 0
  kMean, kBendH, kBendV,    // z where it counts, else 0; dL/dz by the middle pixel of r^h and r^v
  kX, kY = kX + 3, kS = kY + 3, kC = kS + 3,
  kField = kC + 3,          // f_m/n, f_s/n, f_c/n of three channels
  kPlanes = kField + 9
};

struct LossInput {
  const float *color, *depth, *weight;  // target: [H, W, 3], [H, W], [H, W]
  float l1, ssim, depth_weight, smooth, log_gain, offset;
};

struct LossResult {
  double total = 0, l1 = 0, ssim = 0, depth = 0, smooth = 0, d_log_gain = 0, d_offset = 0;
};

class Loss {
 public:
  // Fill the gradient planes from the rendered planes and the target. Sums are made per row and
  // then in order of rows, so the result does not depend on the number of threads.
  LossResult compute(const Layout& layout, float* planes, const LossInput& in, int threads) {
    layout_ = layout;
    planes_ = planes;
    in_ = in;
    gain_ = std::exp(in.log_gain);
    rows_.reserve(layout.height);
    fill_window();
    const int height = layout.height;
#pragma omp parallel num_threads(threads)
    {
#pragma omp for schedule(static)
      for (int y = 0; y < height; ++y) count_row(y);
#pragma omp single
      set_scales();
#pragma omp for schedule(static)
      for (int y = 0; y < height; ++y) pixel_row(y);
      if (in_.ssim > 0) {
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) ssim_row(y);
      }
      if (in_.smooth > 0) {
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) bend_row(y);
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) smooth_row(y);
      }
#pragma omp for schedule(static)
      for (int y = 0; y < height; ++y) finish_row(y);
    }
    return total();
  }

 private:
  static constexpr int kRadius = 5;
  static constexpr float kFar = 1e30f;  // infinite depth is no depth
  static constexpr float kEdge = 10.0f;
  static constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

  struct Row {
    double weight, depth_weight, l1, ssim, depth, smooth, d_log_gain, d_offset;
  };

  float* plane(int which, int y) { return planes_ + which * layout_.plane + layout_.at(y, 0); }

  void fill_window() {
    double sum = 0;
    for (int d = -kRadius; d <= kRadius; ++d) sum += std::exp(-d * d / 4.5);
    for (int d = 0; d <= kRadius; ++d)
      window_[d] = static_cast<float>(std::exp(-d * d / 4.5) / sum);
  }

  static bool usable(float depth) { return depth > 0.0f && depth < kFar; }

  void count_row(int y) {
    Row& row = rows_[y] = Row{};
    const float* weight = in_.weight + static_cast<size_t>(y) * layout_.width;
    const float* depth = in_.depth + static_cast<size_t>(y) * layout_.width;
    float sum = 0, sum_depth = 0;
    for (int x = 0; x < layout_.width; ++x) {
      const float w = weight[x] > 0.0f ? weight[x] : 0.0f;
      sum += w;
      sum_depth += usable(depth[x]) ? w : 0.0f;
    }
    row.weight = sum;
    row.depth_weight = sum_depth;
  }

  void set_scales() {
    double weight = 0, depth_weight = 0;
    for (int y = 0; y < layout_.height; ++y) {
      weight += rows_[y].weight;
      depth_weight += rows_[y].depth_weight;
    }
    per_weight_ = weight > 0 ? static_cast<float>(1.0 / weight) : 0.0f;
    per_depth_ = depth_weight > 0 ? static_cast<float>(1.0 / depth_weight) : 0.0f;
  }

  static Lanes sign(Lanes v) {
    return v > 0.0f ? splat(1.0f) : (v < 0.0f ? splat(-1.0f) : Lanes{});
  }

  // L1 and depth terms, and the planes that SSIM windows run over. Planes are zero beyond the
  // image, and `w` too, so whole vectors may overhang.
  void pixel_row(int y) {
    static thread_local Buffer<float> memory;
    const int width = layout_.width;
    const size_t length = layout_.stride;
    float* target = memory.reserve(4 * length);
    float* depth = target + 3 * length;
    std::memcpy(depth, in_.depth + static_cast<size_t>(y) * width, width * sizeof(float));
    const float* weight = in_.weight + static_cast<size_t>(y) * width;
    const float* pixels = in_.color + static_cast<size_t>(y) * width * 3;
    float* w = plane(kWeight, y);
    for (int x = 0; x < width; ++x) w[x] = weight[x] > 0.0f ? weight[x] : 0.0f;
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < 3; ++c) target[c * length + x] = pixels[3 * x + c];
    Lanes l1 = Lanes{}, depth_error = Lanes{};
    for (int x = 0; x < width; x += kLanes) {
      l1 += color_lanes(y, x, target, length);
      depth_error += depth_lanes(y, x, load(depth + x));
    }
    rows_[y].l1 = sum(l1) / 3.0;
    rows_[y].depth = sum(depth_error);
  }

  Lanes color_lanes(int y, int x, const float* target, size_t length) {
    const Lanes w = load(plane(kWeight, y) + x), zero = Lanes{};
    const Mask counts = w > 0.0f;
    store(plane(kMask, y) + x, counts ? splat(1.0f) : zero);
    const float scale = in_.l1 * per_weight_ / 3.0f;
    Lanes loss = zero;
    for (int c = 0; c < 3; ++c) {
      const Lanes rendered = load(plane(kRed + c, y) + x);
      const Lanes v = counts ? gain_ * rendered + in_.offset : zero;
      const Lanes t = counts ? load(target + c * length + x) : zero;
      store(plane(kX + c, y) + x, v);
      store(plane(kY + c, y) + x, t);
      store(plane(kS + c, y) + x, v * v + t * t);
      store(plane(kC + c, y) + x, v * t);
      store(plane(kGradRed + c, y) + x, scale * w * sign(v - t));
      loss += w * abs(v - t);
    }
    return loss;
  }

  Lanes depth_lanes(int y, int x, Lanes depth) {
    const Lanes zero = Lanes{};
    const Lanes w = load(plane(kWeight, y) + x);
    const Mask known = (depth > 0.0f) & (depth < kFar) & (w > 0.0f);
    const Lanes d = known ? depth : zero, use = known ? w : zero;
    const Lanes error = known ? load(plane(kDepth, y) + x) - load(plane(kSilhouette, y) + x) * d
                              : zero;
    const Lanes by_depth = (in_.depth_weight * per_depth_) * use * sign(error);
    store(plane(kGradDepth, y) + x, by_depth);
    store(plane(kGradSilhouette, y) + x, -by_depth * d);
    if (in_.smooth > 0) {
      const Lanes silhouette = load(plane(kSilhouette, y) + x);
      const Mask counts = (silhouette > 0.5f) & (w > 0.0f);
      const Lanes z = load(plane(kDepth, y) + x) / max(silhouette, splat(0.5f));
      store(plane(kMean, y) + x, counts ? max(z, zero) : zero);
    }
    return use * abs(error);
  }

  // w e r of the triple around (x, y) along `step`, and its derivative by the middle depth.
  Lanes bend(int y, int x, ptrdiff_t step, Lanes* slope) {
    const float* z = plane(kMean, y) + x;
    const Lanes before = load(z - step), middle = load(z), after = load(z + step);
    const Mask counts = (before > 0.0f) & (middle > 0.0f) & (after > 0.0f);
    Lanes edge = Lanes{};
    for (int c = 0; c < 3; ++c) {
      const float* t = plane(kY + c, y) + x;
      const Lanes one = load(t) - load(t - step), other = load(t) - load(t + step);
      edge += one * one + other * other;
    }
    const Lanes e = exp2(max(edge * (-kEdge / 3.0f * kLog2E), splat(-100.0f)));
    const Lanes weight = counts ? e * load(plane(kWeight, y) + x) : Lanes{};
    const Lanes r = middle - 2.0f * before * after / max(before + after, splat(1e-6f));
    *slope = (in_.smooth * per_weight_) * weight * sign(r);
    return weight * abs(r);
  }

  void bend_row(int y) {
    Lanes loss = Lanes{}, slope;
    for (int x = 0; x < layout_.width; x += kLanes) {
      loss += bend(y, x, 1, &slope);
      store(plane(kBendH, y) + x, slope);
      loss += bend(y, x, static_cast<ptrdiff_t>(layout_.stride), &slope);
      store(plane(kBendV, y) + x, slope);
    }
    rows_[y].smooth = sum(loss);
  }

  // dL/dz at (x, y) from the three triples along `step` that it is part of.
  static Lanes bend_backward(const float* z, const float* slope, ptrdiff_t step) {
    const Lanes middle = load(z), before = load(z - 2 * step), after = load(z + 2 * step);
    const Lanes of_after = after / max(middle + after, splat(1e-6f));
    const Lanes of_before = before / max(middle + before, splat(1e-6f));
    return load(slope) - 2.0f * (load(slope + step) * of_after * of_after +
                                 load(slope - step) * of_before * of_before);
  }

  void smooth_row(int y) {
    const ptrdiff_t down = static_cast<ptrdiff_t>(layout_.stride);
    const float* z = plane(kMean, y);
    for (int x = 0; x < layout_.width; x += kLanes) {
      const Lanes d_mean = bend_backward(z + x, plane(kBendH, y) + x, 1) +
                           bend_backward(z + x, plane(kBendV, y) + x, down);
      const Lanes by_depth = d_mean / max(load(plane(kSilhouette, y) + x), splat(0.5f));
      float *depth = plane(kGradDepth, y) + x, *silhouette = plane(kGradSilhouette, y) + x;
      store(depth, load(depth) + by_depth);
      store(silhouette, load(silhouette) - by_depth * load(z + x));
    }
  }

  // Vertical half of the window for row y; `out` also covers the border that the other half needs.
  void blur_columns(const float* in, float* out) const {
    const ptrdiff_t stride = static_cast<ptrdiff_t>(layout_.stride);
    for (int x = -Layout::kBorder; x < layout_.width + kRadius; x += kLanes) {
      Lanes sum = window_[0] * load(in + x);
      for (int d = 1; d <= kRadius; ++d)
        sum += window_[d] * (load(in + x - d * stride) + load(in + x + d * stride));
      store(out + Layout::kBorder + x, sum);
    }
  }

  Lanes blur_row(const float* columns, int x) const {
    const float* at = columns + Layout::kBorder + x;
    Lanes sum = window_[0] * load(at);
    for (int d = 1; d <= kRadius; ++d) sum += window_[d] * (load(at - d) + load(at + d));
    return sum;
  }

  void ssim_row(int y) {
    static thread_local Buffer<float> memory;
    const size_t length = layout_.stride + 2 * kLanes;
    float* columns = memory.reserve(13 * length);
    blur_columns(plane(kMask, y), columns);
    for (int k = 0; k < 12; ++k) blur_columns(plane(kX + k, y), columns + (1 + k) * length);
    const float* weight = plane(kWeight, y);
    const float scale = in_.ssim * per_weight_ / 3.0f;
    Lanes loss = Lanes{};
    for (int x = 0; x < layout_.width; x += kLanes) {
      const Lanes w = load(weight + x);
      const Lanes per_n = 1.0f / max(blur_row(columns, x), splat(1e-6f));
      for (int c = 0; c < 3; ++c) {
        const Lanes mx = per_n * blur_row(columns + (1 + c) * length, x);
        const Lanes my = per_n * blur_row(columns + (4 + c) * length, x);
        const Lanes ss = per_n * blur_row(columns + (7 + c) * length, x);
        const Lanes cc = per_n * blur_row(columns + (10 + c) * length, x);
        const Lanes a1 = 2.0f * mx * my + kC1, a2 = 2.0f * (cc - mx * my) + kC2;
        const Lanes mm = mx * mx + my * my;
        const Lanes b1 = mm + kC1, b2 = max(ss - mm, Lanes{}) + kC2;
        const Lanes per_b1 = 1.0f / b1, per_b2 = 1.0f / b2, per_b = per_b1 * per_b2;
        const Lanes f = a1 * a2 * per_b;
        const Lanes g = -scale * w * per_n;
        const Lanes f_m = 2.0f * (my * (a2 - a1) * per_b + mx * f * (per_b2 - per_b1));
        store(plane(kField + c, y) + x, g * f_m);
        store(plane(kField + 3 + c, y) + x, -g * f * per_b2);
        store(plane(kField + 6 + c, y) + x, 2.0f * g * a1 * per_b);
        loss += w * (1.0f - f);
      }
    }
    rows_[y].ssim = sum(loss) / 3.0;
  }

  // Add the gradient of SSIM, and go through the exposure.
  void finish_row(int y) {
    static thread_local Buffer<float> memory;
    const size_t length = layout_.stride + 2 * kLanes;
    float* columns = memory.reserve(9 * length);
    const bool ssim = in_.ssim > 0;
    for (int k = 0; ssim && k < 9; ++k) blur_columns(plane(kField + k, y), columns + k * length);
    const float* mask = plane(kMask, y);
    Lanes d_offset = Lanes{}, d_log_gain = Lanes{};
    for (int c = 0; c < 3; ++c) {
      const float *px = plane(kX + c, y), *py = plane(kY + c, y);
      float* grad = plane(kGradRed + c, y);
      for (int i = 0; i < layout_.width; i += kLanes) {
        const Lanes x = load(px + i);
        Lanes g = load(grad + i);
        if (ssim)
          g += load(mask + i) * (blur_row(columns + c * length, i) +
                                 2.0f * x * blur_row(columns + (3 + c) * length, i) +
                                 load(py + i) * blur_row(columns + (6 + c) * length, i));
        d_offset += g;
        d_log_gain += g * (x - in_.offset);
        store(grad + i, g * gain_);
      }
    }
    rows_[y].d_offset = sum(d_offset);
    rows_[y].d_log_gain = sum(d_log_gain);
  }

  LossResult total() const {
    LossResult out;
    for (int y = 0; y < layout_.height; ++y) {
      out.l1 += rows_[y].l1 * per_weight_;
      out.ssim += rows_[y].ssim * per_weight_;
      out.depth += rows_[y].depth * per_depth_;
      out.smooth += rows_[y].smooth * per_weight_;
      out.d_log_gain += rows_[y].d_log_gain;
      out.d_offset += rows_[y].d_offset;
    }
    out.total = in_.l1 * out.l1 + in_.ssim * out.ssim + in_.depth_weight * out.depth +
                in_.smooth * out.smooth;
    return out;
  }

  Layout layout_;
  float* planes_ = nullptr;
  LossInput in_{};
  float gain_ = 1, per_weight_ = 0, per_depth_ = 0;
  float window_[kRadius + 1] = {};
  Buffer<Row> rows_;
};

}  // namespace bdgs
