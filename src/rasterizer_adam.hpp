// One step of Adam (Kingma and Ba, 2015, algorithm 1), in place; step 0 leaves out the correction of
// the moments' bias.

#pragma once

#include <array>
#include <cmath>
#include <vector>

#include <pybind11/numpy.h>

#include "rasterizer_simd.hpp"

namespace bdgs {

struct AdamStep {
  float rate, beta1, beta2, rest1, rest2, eps, correction2;  // bias correction folded into rate
};

inline void adam_lanes(const AdamStep& s, float* p, const float* g, float* m, float* v) {
  const Lanes grad = load(g);
  const Lanes first = s.beta1 * load(m) + s.rest1 * grad;
  const Lanes second = s.beta2 * load(v) + s.rest2 * grad * grad;
  store(m, first);
  store(v, second);
  store(p, load(p) - s.rate * first / (sqrt(second * s.correction2) + s.eps));
}

inline void adam_one(const AdamStep& s, float& p, float g, float& m, float& v) {
  m = s.beta1 * m + s.rest1 * g;
  v = s.beta2 * v + s.rest2 * g * g;
  p -= s.rate * m / (std::sqrt(v * s.correction2) + s.eps);
}

// Whole vectors where all rows they hold are wanted, single elements elsewhere.
inline void adam_range(const AdamStep& s, float* p, const float* g, float* m, float* v,
                       const uint8_t* rows, ptrdiff_t columns, ptrdiff_t from, ptrdiff_t to) {
  ptrdiff_t i = from;
  for (; i + kLanes <= to; i += kLanes) {
    int wanted = kLanes;
    if (rows != nullptr) {
      wanted = 0;
      ptrdiff_t row = i / columns, column = i % columns;
      for (int l = 0; l < kLanes; ++l) {
        wanted += rows[row];
        if (++column == columns) column = 0, ++row;
      }
    }
    if (wanted == kLanes) {
      adam_lanes(s, p + i, g + i, m + i, v + i);
    } else if (wanted > 0) {
      for (ptrdiff_t k = i; k < i + kLanes; ++k)
        if (rows[k / columns]) adam_one(s, p[k], g[k], m[k], v[k]);
    }
  }
  for (; i < to; ++i)
    if (rows == nullptr || rows[i / columns]) adam_one(s, p[i], g[i], m[i], v[i]);
}

inline void adam_step(pybind11::array_t<float, 16> params, pybind11::array_t<float, 16> grads,
                      pybind11::array_t<float, 16> first, pybind11::array_t<float, 16> second,
                      int step, double rate, std::array<double, 2> betas, double eps,
                      pybind11::object mask, int threads) {
  AdamStep s{};
  const bool corrected = step > 0;
  s.rate = static_cast<float>(corrected ? rate / (1.0 - std::pow(betas[0], step)) : rate);
  s.beta1 = static_cast<float>(betas[0]);
  s.beta2 = static_cast<float>(betas[1]);
  s.rest1 = static_cast<float>(1.0 - betas[0]);
  s.rest2 = static_cast<float>(1.0 - betas[1]);
  s.eps = static_cast<float>(eps);
  s.correction2 = corrected ? static_cast<float>(1.0 / (1.0 - std::pow(betas[1], step))) : 1.0f;
  const ptrdiff_t size = params.size();
  const ptrdiff_t columns = params.ndim() > 1 ? params.shape(1) : 1;
  float *p = params.mutable_data(), *m = first.mutable_data(), *v = second.mutable_data();
  const float* g = grads.data();
  pybind11::array_t<uint8_t, 16> wanted;
  if (!mask.is_none()) wanted = mask.cast<pybind11::array_t<uint8_t, 16>>();
  const uint8_t* rows = mask.is_none() ? nullptr : wanted.data();
  pybind11::gil_scoped_release release;
  const ptrdiff_t chunk = 1 << 14;  // elements; a multiple of kLanes
#pragma omp parallel for schedule(static) num_threads(threads)
  for (ptrdiff_t from = 0; from < size; from += chunk)
    adam_range(s, p, g, m, v, rows, columns, from, from + chunk < size ? from + chunk : size);
}

}  // namespace bdgs
