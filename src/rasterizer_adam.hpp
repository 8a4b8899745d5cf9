// One step of Adam (Kingma and Ba, 2015, algorithm 1), in place, on several arrays that share their
// rows; step 0 leaves out the correction of the moments' bias.
//
// kLanes rows at a time: most often all of them are wanted or none. Else whole vectors are computed
// and the rows that are not wanted keep what they had.

#pragma once

#include <array>
#include <cmath>
#include <stdexcept>
#include <vector>

#include <pybind11/numpy.h>

#include "rasterizer_simd.hpp"

namespace bdgs {

struct AdamConstants {
  float beta1, beta2, rest1, rest2, eps, correction2;
};

struct AdamArrays {
  float* params;
  const float* grads;
  float *first, *second;
  ptrdiff_t columns;
  float rate;  // with the correction of the first moment's bias
};

inline void adam_lanes(const AdamConstants& c, float rate, Mask wanted, const float* grads,
                       float* params, float* first, float* second) {
  const Lanes g = load(grads), old_m = load(first), old_v = load(second), p = load(params);
  const Lanes m = c.beta1 * old_m + c.rest1 * g;
  const Lanes v = c.beta2 * old_v + c.rest2 * g * g;
  const Lanes moved = p - rate * m / (sqrt(v * c.correction2) + c.eps);
  store(first, wanted ? m : old_m);
  store(second, wanted ? v : old_v);
  store(params, wanted ? moved : p);
}

inline void adam_one(const AdamConstants& c, const AdamArrays& a, ptrdiff_t i) {
  const float g = a.grads[i];
  a.first[i] = c.beta1 * a.first[i] + c.rest1 * g;
  a.second[i] = c.beta2 * a.second[i] + c.rest2 * g * g;
  a.params[i] -= a.rate * a.first[i] / (std::sqrt(a.second[i] * c.correction2) + c.eps);
}

// kLanes rows from `row` on; `wanted` has one lane per row.
template <int kColumns>
inline void adam_rows(const AdamConstants& c, const AdamArrays& a, ptrdiff_t row, Lanes wanted) {
  Lanes rows[kColumns];
  for (int k = 0; k < kColumns; ++k) rows[k] = wanted;
  alignas(64) float elements[kColumns * kLanes];
  join_columns<kColumns>(rows, elements);
  const ptrdiff_t at = row * kColumns;
  for (int k = 0; k < kColumns * kLanes; k += kLanes)
    adam_lanes(c, a.rate, load(elements + k) > 0.0f, a.grads + at + k, a.params + at + k,
               a.first + at + k, a.second + at + k);
}

constexpr ptrdiff_t kStretch = 64 * kLanes;  // rows that a thread takes at a time

// Rows from .. from + count - 1; `wanted` is 1 or 0 for each of them.
inline void adam_stretch(const AdamConstants& c, const AdamArrays& a, const float* wanted,
                         ptrdiff_t from, ptrdiff_t count) {
  const bool by_vectors = a.columns == 1 || a.columns == 3 || a.columns == 4;
  ptrdiff_t row = 0;
  for (; by_vectors && row + kLanes <= count; row += kLanes) {
    const Lanes rows = load(wanted + row);
    if (!any(rows > 0.0f)) continue;
    if (a.columns == 1) adam_rows<1>(c, a, from + row, rows);
    if (a.columns == 3) adam_rows<3>(c, a, from + row, rows);
    if (a.columns == 4) adam_rows<4>(c, a, from + row, rows);
  }
  for (; row < count; ++row)
    if (wanted[row] > 0.0f)
      for (ptrdiff_t k = 0; k < a.columns; ++k) adam_one(c, a, (from + row) * a.columns + k);
}

// `groups`: tuples (params, grads, first, second, rate) with the same number of rows.
inline void adam_steps(const std::vector<pybind11::tuple>& groups, int step,
                       std::array<double, 2> betas, double eps, const pybind11::object& mask,
                       int threads) {
  using Floats = pybind11::array_t<float, pybind11::array::c_style>;
  const double correction1 = step > 0 ? 1.0 - std::pow(betas[0], step) : 1.0;
  const double correction2 = step > 0 ? 1.0 - std::pow(betas[1], step) : 1.0;
  const AdamConstants c{static_cast<float>(betas[0]),       static_cast<float>(betas[1]),
                        static_cast<float>(1.0 - betas[0]), static_cast<float>(1.0 - betas[1]),
                        static_cast<float>(eps),            static_cast<float>(1.0 / correction2)};
  std::vector<AdamArrays> arrays;
  ptrdiff_t count = 0;
  for (const pybind11::tuple& group : groups) {
    Floats params = group[0].cast<Floats>();
    count = params.ndim() > 0 ? params.shape(0) : 1;
    arrays.push_back({params.mutable_data(), group[1].cast<Floats>().data(),
                      group[2].cast<Floats>().mutable_data(),
                      group[3].cast<Floats>().mutable_data(), count > 0 ? params.size() / count : 0,
                      static_cast<float>(group[4].cast<double>() / correction1)});
  }
  const uint8_t* rows =
      mask.is_none()
          ? nullptr
          : mask.cast<pybind11::array_t<uint8_t, pybind11::array::c_style>>().data();
  pybind11::gil_scoped_release release;
#pragma omp parallel for schedule(static) num_threads(threads)
  for (ptrdiff_t from = 0; from < count; from += kStretch) {
    const ptrdiff_t here = from + kStretch < count ? kStretch : count - from;
    alignas(64) float wanted[kStretch];
    for (ptrdiff_t row = 0; row < here; ++row)
      wanted[row] = rows == nullptr ? 1.0f : static_cast<float>(rows[from + row]);
    for (const AdamArrays& a : arrays) adam_stretch(c, a, wanted, from, here);
  }
}

}  // namespace bdgs
