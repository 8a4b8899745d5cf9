// The loss of one view and its gradient with respect to the rendered planes.
//
//   I   = exp(log_gain) C + offset                        exposure of the target, C rendered
//   E   = sum_p w_p [ l1 |I - T|_p + ssim (1 - SSIM_p) ] / sum_p w_p
//       + sum_{p: D_p > 0} w_p (depth |S| |Z / S - D|_p + empty (1 - S_p)) / sum_{p: D_p > 0} w_p
//       + smooth sum_p w_p (e_p^h r_p^h + e_p^v r_p^v) / sum_p w_p
//
// |.| and SSIM are means over the three channels. Z = sum of weights times depth and S =
// silhouette; Z / S is the depth that the map shows. The factor |S| is not differentiated: it lets
// what hardly shows pull hardly, where Z / S - D alone would pull without bound at the rim of the
// map; and if it were differentiated, a depth that is off would be cured by making the surface
// transparent. The last term wants the map opaque wherever the camera measured a surface.
//
// The `smooth` term is the edge-aware smoothness that stands for the image-gradient term of Eq. 8,
// after `depth_reg` of MonoGS (Matsuki et al., 2024): there e |dZ| with e = exp(-10 |grad T|^2). A
// first difference would turn every wall towards the camera, so here r compares a pixel's mean
// depth z = Z/S with that of the line through its two neighbours, along the row (h) and the column:
//   r = |z - 2 z_- z_+ / (z_- + z_+)|      0 on any plane, because 1/z is affine in the image
//   e = exp(-10 (|T - T_-|^2 + |T - T_+|^2)) with means over the channels
// and counts only if all three pixels have w > 0 and S > 0.5: a hole is not a cliff.
//
// SSIM uses the usual 11 x 11 window, sigma 1.5 px, and constants for images in [0, 1]. The window
// is cut to the pixels with w > 0 inside the image and normalised over them, so what a moving
// object hides is in nobody's statistics. With n, mx, my, s, c the windowed sums of 1, x, y,
// x^2 + y^2 and x y over those pixels, SSIM is a function f(mx/n, s/n, c/n), and the gradient with
// respect to x is three more windows: blur(f_m/n) + 2 x blur(f_s/n) + y blur(f_c/n).
//
// The windows are separable, and run down the image in one sweep. A row's 13 planes (mask, x, y,
// x^2 + y^2, x y) are blurred along the row while they are in the nearest cache and go to a ring
// of 16 rows; four rows at a time are blurred down the ring, become SSIM and its three fields f/n,
// and those go through a second ring in the same way. Planes of the whole image would not fit the
// cache.

#pragma once

#include <algorithm>
#include <vector>

#include <omp.h>

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
  kWeight, kTargetDepth,    // w, and D where it is known, else 0
  kTarget,                  // T where w > 0, else 0; three channels
  kMean = kTarget + 3,      // z where it counts, else 0
  kBendH, kBendV,           // dL/dz by the middle pixel of r^h and r^v
  kPlanes
};

struct LossInput {
  const float *color, *depth, *weight;  // target: [H, W, 3], [H, W], [H, W]
  float l1, ssim, depth_weight, smooth, empty, log_gain, offset;
};

struct LossResult {
  double total = 0, l1 = 0, ssim = 0, depth = 0, smooth = 0, empty = 0, d_log_gain = 0;
  double d_offset = 0;
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
    if (sweeps_.size() < static_cast<size_t>(threads)) sweeps_.resize(threads);
    fill_window();
    const int height = layout.height;
#pragma omp parallel num_threads(threads)
    {
#pragma omp for schedule(static)
      for (int y = 0; y < height; ++y) read_row(y);
#pragma omp single
      set_scales();
      const int thread = omp_get_thread_num(), team = omp_get_num_threads();
      const int begin = height * thread / team, end = height * (thread + 1) / team;
      if (in_.ssim > 0)
        sweep(begin, end, sweeps_[thread]);
      else
        for (int y = begin; y < end; ++y) finish_row(y);
      if (in_.smooth > 0) {
#pragma omp barrier
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) bend_row(y);
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) smooth_row(y);
      }
    }
    return total();
  }

 private:
  static constexpr int kRadius = 5;
  static constexpr float kFar = 1e30f;  // infinite depth is no depth
  static constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
  static constexpr float kEdge = 10.0f;
  static constexpr int kWindowed = 13, kFields = 9;  // planes in the two rings
  static constexpr int kRing = 16, kQuad = 4;        // rows

  struct Row {
    double weight, depth_weight, l1, ssim, depth, smooth, empty, d_log_gain, d_offset;
  };

  struct RowSums {
    Lanes l1, depth, empty, d_log_gain, d_offset;
  };

  // A thread's rings, and the row that it is blurring.
  struct Sweep {
    Buffer<float> row, windowed, fields;
  };

  float* plane(int which, int y) { return planes_ + which * layout_.plane + layout_.at(y, 0); }

  void fill_window() {
    double sum = 0;
    for (int d = -kRadius; d <= kRadius; ++d) sum += std::exp(-d * d / 4.5);
    for (int d = 0; d <= kRadius; ++d)
      window_[d] = static_cast<float>(std::exp(-d * d / 4.5) / sum);
  }

  // Target and weight become planes. These are zero beyond the image, so vectors may overhang.
  void read_row(int y) {
    const int width = layout_.width;
    const float* weight = in_.weight + static_cast<size_t>(y) * width;
    const float* pixels = in_.color + static_cast<size_t>(y) * width * 3;
    float *w = plane(kWeight, y), *depth = plane(kTargetDepth, y);
    for (int x = 0; x < width; ++x) w[x] = weight[x] > 0.0f ? weight[x] : 0.0f;
    std::memcpy(depth, in_.depth + static_cast<size_t>(y) * width, width * sizeof(float));
    Lanes sum_w = Lanes{}, sum_depth = Lanes{};
    for (int x = 0; x < width; x += kLanes) {
      const Lanes weights = load(w + x), d = load(depth + x), zero = Lanes{};
      const Mask known = (d > 0.0f) & (d < kFar) & (weights > 0.0f);
      store(depth + x, known ? d : zero);
      Lanes color[3];
      load_rows<3>(pixels, x, width, color);
      for (int c = 0; c < 3; ++c)
        store(plane(kTarget + c, y) + x, weights > 0.0f ? color[c] : zero);
      sum_w += weights;
      sum_depth += known ? weights : zero;
    }
    rows_[y] = Row{};
    rows_[y].weight = sum(sum_w);
    rows_[y].depth_weight = sum(sum_depth);
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

  // ---- SSIM ------------------------------------------------------------------------------------

  // Rows begin .. end - 1, with what they need of the rows around. Beyond the image all is zero.
  void sweep(int begin, int end, Sweep& s) {
    const size_t length = layout_.stride;
    s.row.reserve(kQuad * kWindowed * length);
    s.windowed.reserve(kRing * kWindowed * length);
    s.fields.reserve(kRing * kFields * length);
    int next = begin - 2 * kRadius;
    for (int y = begin - kRadius; y < end + kRadius; y += kQuad) {
      for (; next < y + kQuad + kRadius; ++next) window_row(next, s);
      ssim_rows(y, begin, end, s);
      finish_rows(y - kRadius, begin, end, s);
    }
  }

  // Blur kCount planes of a row along it; `in` has kBorder zeros on both sides of each.
  template <int kCount>
  void blur_along(const float* in, float* out) const {
    const size_t length = layout_.stride;
    for (int k = 0; k < kCount; ++k, in += length, out += length)
      for (int x = 0; x < layout_.width; x += kLanes) {
        const Neighbours at(in + Layout::kBorder + x);
        Lanes sum = window_[0] * at.shifted<0>();
        sum += window_[1] * (at.shifted<-1>() + at.shifted<1>());
        sum += window_[2] * (at.shifted<-2>() + at.shifted<2>());
        sum += window_[3] * (at.shifted<-3>() + at.shifted<3>());
        sum += window_[4] * (at.shifted<-4>() + at.shifted<4>());
        sum += window_[5] * (at.shifted<-5>() + at.shifted<5>());
        store(out + x, sum);
      }
  }

  // Blur rows y .. y + 3 of plane k down a ring, at column x.
  template <int kCount>
  void blur_down(const float* const* rows, int k, int x, Lanes (*out)[kCount]) const {
    const size_t at = k * layout_.stride + x;
    Lanes sums[kQuad] = {};
#pragma GCC unroll 16
    for (int from = 0; from < kQuad + 2 * kRadius; ++from) {
      const Lanes v = load(rows[from] + at);
#pragma GCC unroll 4
      for (int q = 0; q < kQuad; ++q) {
        const int d = from - kRadius - q;
        if (d >= -kRadius && d <= kRadius) sums[q] += window_[d < 0 ? -d : d] * v;
      }
    }
    for (int q = 0; q < kQuad; ++q) out[q][k] = sums[q];
  }

  template <int kCount>
  void ring_rows(const float* ring, int y, const float** rows) const {
    for (int from = 0; from < kQuad + 2 * kRadius; ++from)
      rows[from] = ring + ((y - kRadius + from) & (kRing - 1)) * kCount * layout_.stride;
  }

  template <int kCount>
  void clear_borders(float* row) const {
    const size_t length = layout_.stride;
    const int last = (layout_.width + kLanes - 1) / kLanes * kLanes;
    for (int k = 0; k < kCount; ++k, row += length)
      for (int x = 0; x < Layout::kBorder; ++x) {
        row[x] = 0.0f;
        row[Layout::kBorder + last + x] = 0.0f;
      }
  }

  // Mask, x, y, x^2 + y^2 and x y of a row, blurred along it.
  void window_row(int y, Sweep& s) {
    const size_t length = layout_.stride;
    float* row = s.row.data() + Layout::kBorder;
    for (int x = 0; x < layout_.width; x += kLanes) {
      const Mask counts = load(plane(kWeight, y) + x) > 0.0f;
      store(row + x, counts ? splat(1.0f) : Lanes{});
      for (int c = 0; c < 3; ++c) {
        const Lanes v =
            counts ? gain_ * load(plane(kRed + c, y) + x) + in_.offset : Lanes{};
        const Lanes t = load(plane(kTarget + c, y) + x);
        store(row + (1 + c) * length + x, v);
        store(row + (4 + c) * length + x, t);
        store(row + (7 + c) * length + x, v * v + t * t);
        store(row + (10 + c) * length + x, v * t);
      }
    }
    clear_borders<kWindowed>(s.row.data());
    float* to = s.windowed.data() + (y & (kRing - 1)) * kWindowed * length;
    blur_along<kWindowed>(s.row.data(), to);
  }

  // SSIM of rows y .. y + 3 and its fields, blurred along the rows.
  void ssim_rows(int y, int begin, int end, Sweep& s) {
    const size_t length = layout_.stride;
    const float* rows[kQuad + 2 * kRadius];
    ring_rows<kWindowed>(s.windowed.data(), y, rows);
    Lanes loss[kQuad] = {};
    for (int x = 0; x < layout_.width; x += kLanes) {
      Lanes blurred[kQuad][kWindowed];
      for (int k = 0; k < kWindowed; ++k) blur_down<kWindowed>(rows, k, x, blurred);
      for (int q = 0; q < kQuad; ++q)
        loss[q] += ssim_lanes(load(plane(kWeight, y + q) + x), blurred[q],
                              s.row.data() + q * kFields * length + Layout::kBorder + x);
    }
    for (int q = 0; q < kQuad; ++q) {
      float* row = s.row.data() + q * kFields * length;
      clear_borders<kFields>(row);
      blur_along<kFields>(row, s.fields.data() + ((y + q) & (kRing - 1)) * kFields * length);
      if (y + q >= begin && y + q < end) rows_[y + q].ssim = sum(loss[q]) / 3.0;
    }
  }

  // w (1 - SSIM), from windowed sums of mask, x, y, x^2 + y^2, x y; stores the fields.
  Lanes ssim_lanes(Lanes w, const Lanes* in, float* fields) const {
    const size_t length = layout_.stride;
    const float scale = in_.ssim * per_weight_ / 3.0f;
    const Lanes per_n = 1.0f / max(in[0], splat(1e-6f));
    Lanes loss = Lanes{};
    for (int c = 0; c < 3; ++c) {
      const Lanes mx = per_n * in[1 + c], my = per_n * in[4 + c];
      const Lanes ss = per_n * in[7 + c], cc = per_n * in[10 + c];
      const Lanes a1 = 2.0f * mx * my + kC1, a2 = 2.0f * (cc - mx * my) + kC2;
      const Lanes mm = mx * mx + my * my;
      const Lanes b1 = mm + kC1, b2 = max(ss - mm, Lanes{}) + kC2;
      const Lanes per_b1 = 1.0f / b1, per_b2 = 1.0f / b2, per_b = per_b1 * per_b2;
      const Lanes f = a1 * a2 * per_b;
      const Lanes g = -scale * w * per_n;
      const Lanes f_m = 2.0f * (my * (a2 - a1) * per_b + mx * f * (per_b2 - per_b1));
      store(fields + c * length, g * f_m);
      store(fields + (3 + c) * length, -g * f * per_b2);
      store(fields + (6 + c) * length, 2.0f * g * a1 * per_b);
      loss += w * (1.0f - f);
    }
    return loss;
  }

  // ---- gradients by the rendered planes --------------------------------------------------------

  void finish_rows(int y, int begin, int end, Sweep& s) {
    if (y + kQuad <= begin || y >= end) return;
    const float* rows[kQuad + 2 * kRadius];
    ring_rows<kFields>(s.fields.data(), y, rows);
    const int first = std::max(begin - y, 0), last = std::min(end - y, kQuad);
    RowSums sums[kQuad] = {};
    for (int x = 0; x < layout_.width; x += kLanes) {
      Lanes blurred[kQuad][kFields];
      for (int k = 0; k < kFields; ++k) blur_down<kFields>(rows, k, x, blurred);
      for (int q = first; q < last; ++q) finish_lanes(y + q, x, blurred[q], sums[q]);
    }
    for (int q = first; q < last; ++q) store_sums(y + q, sums[q]);
  }

  void finish_row(int y) {
    RowSums sums = {};
    const Lanes none[kFields] = {};
    for (int x = 0; x < layout_.width; x += kLanes) finish_lanes(y, x, none, sums);
    store_sums(y, sums);
  }

  void store_sums(int y, const RowSums& sums) {
    rows_[y].l1 = sum(sums.l1) / 3.0;
    rows_[y].depth = sum(sums.depth);
    rows_[y].empty = sum(sums.empty);
    rows_[y].d_log_gain = sum(sums.d_log_gain);
    rows_[y].d_offset = sum(sums.d_offset);
  }

  // L1, what the blurred fields give for SSIM, both through the exposure; and the depth term.
  void finish_lanes(int y, int x, const Lanes* fields, RowSums& sums) {
    const Lanes w = load(plane(kWeight, y) + x);
    const Mask counts = w > 0.0f;
    const Lanes zero = Lanes{};
    const float scale = in_.l1 * per_weight_ / 3.0f;
    for (int c = 0; c < 3; ++c) {
      const Lanes rendered = gain_ * load(plane(kRed + c, y) + x);
      const Lanes v = rendered + in_.offset, t = load(plane(kTarget + c, y) + x);
      const Lanes by_ssim = fields[c] + 2.0f * v * fields[3 + c] + t * fields[6 + c];
      const Lanes g = counts ? scale * w * sign(v - t) + by_ssim : zero;
      sums.l1 += w * abs(v - t);
      sums.d_offset += g;
      sums.d_log_gain += g * rendered;
      store(plane(kGradRed + c, y) + x, g * gain_);
    }
    depth_lanes(y, x, w, sums);
  }

  void depth_lanes(int y, int x, Lanes w, RowSums& sums) {
    const Lanes zero = Lanes{}, d = load(plane(kTargetDepth, y) + x);
    const Lanes z = load(plane(kDepth, y) + x), silhouette = load(plane(kSilhouette, y) + x);
    const Lanes use = d > 0.0f ? w : zero, error = z - silhouette * d;
    const Lanes by_depth = (in_.depth_weight * per_depth_) * use * sign(error);
    store(plane(kGradDepth, y) + x, by_depth);
    store(plane(kGradSilhouette, y) + x,
          -by_depth * z / max(silhouette, splat(1e-6f)) - (in_.empty * per_depth_) * use);
    if (in_.smooth > 0) {
      const Mask counts = (silhouette > 0.5f) & (w > 0.0f);
      const Lanes mean = z / max(silhouette, splat(0.5f));
      store(plane(kMean, y) + x, counts ? max(mean, zero) : zero);
    }
    sums.depth += use * abs(error);
    sums.empty += use * (1.0f - silhouette);
  }

  // ---- smoothness ------------------------------------------------------------------------------

  // w e r of the triple around (x, y) along `step`, and its derivative by the middle depth.
  Lanes bend(int y, int x, ptrdiff_t step, Lanes* slope) {
    const float* z = plane(kMean, y) + x;
    const Lanes before = load(z - step), middle = load(z), after = load(z + step);
    const Mask counts = (before > 0.0f) & (middle > 0.0f) & (after > 0.0f);
    Lanes edge = Lanes{};
    for (int c = 0; c < 3; ++c) {
      const float* t = plane(kTarget + c, y) + x;
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

  LossResult total() const {
    LossResult out;
    for (int y = 0; y < layout_.height; ++y) {
      out.l1 += rows_[y].l1 * per_weight_;
      out.ssim += rows_[y].ssim * per_weight_;
      out.depth += rows_[y].depth * per_depth_;
      out.empty += rows_[y].empty * per_depth_;
      out.smooth += rows_[y].smooth * per_weight_;
      out.d_log_gain += rows_[y].d_log_gain;
      out.d_offset += rows_[y].d_offset;
    }
    out.total = in_.l1 * out.l1 + in_.ssim * out.ssim + in_.depth_weight * out.depth +
                in_.smooth * out.smooth + in_.empty * out.empty;
    return out;
  }

  Layout layout_;
  float* planes_ = nullptr;
  LossInput in_{};
  float gain_ = 1, per_weight_ = 0, per_depth_ = 0;
  float window_[kRadius + 1] = {};
  Buffer<Row> rows_;
  std::vector<Sweep> sweeps_;
};

}  // namespace bdgs
