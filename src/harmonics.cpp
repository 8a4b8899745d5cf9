// View-dependent colours and their derivatives, one Gaussian after the other, without temporaries.
//
// The readable twin is `basis`, `Shading._colors` and `Shading._gradient` in
// bdgs_ros/mapping/harmonics.py, where the method is explained; this file only saves their
// intermediate arrays, which cost more than the arithmetic.

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>
#include <type_traits>

namespace py = pybind11;

namespace {

using Floats = py::array_t<float, py::array::c_style>;
using Flags = py::array_t<bool, py::array::c_style>;

constexpr float kLeast = 1e-6f;  // a Gaussian in the camera's centre is seen from no direction

// Y_1 .. Y_K of a unit vector, as 3DGS orders and signs them.
template <int K>
inline void basis(float x, float y, float z, float* out) {
  out[0] = -0.48860251190292f * y;
  out[1] = 0.48860251190292f * z;
  out[2] = -0.48860251190292f * x;
  if constexpr (K > 3) {
    const float xx = x * x, yy = y * y, zz = z * z;
    out[3] = 1.09254843059208f * x * y;
    out[4] = -1.09254843059208f * y * z;
    out[5] = 0.31539156525252f * (2 * zz - xx - yy);
    out[6] = -1.09254843059208f * x * z;
    out[7] = 0.54627421529604f * (xx - yy);
    if constexpr (K > 8) {
      out[8] = -0.59004358992664f * y * (3 * xx - yy);
      out[9] = 2.89061144264055f * x * y * z;
      out[10] = -0.45704579946447f * y * (4 * zz - xx - yy);
      out[11] = 0.37317633259012f * z * (2 * zz - 3 * xx - 3 * yy);
      out[12] = -0.45704579946447f * x * (4 * zz - xx - yy);
      out[13] = 1.44530572132028f * z * (xx - yy);
      out[14] = -0.59004358992664f * x * (xx - 3 * yy);
    }
  }
}

template <int K>
inline void basis_from(const std::array<float, 3>& centre, const float* mean, float* out) {
  const float x = mean[0] - centre[0], y = mean[1] - centre[1], z = mean[2] - centre[2];
  const float inverse = 1 / std::max(std::sqrt(x * x + y * y + z * z), kLeast);
  basis<K>(x * inverse, y * inverse, z * inverse, out);
}

template <int K>
void colors_of(const std::array<float, 3>& centre, const float* means, const float* harmonics,
               const bool* rows, float* colors, ptrdiff_t count, int threads) {
#pragma omp parallel for schedule(static) num_threads(threads)
  for (ptrdiff_t i = 0; i < count; ++i) {
    if (!rows[i]) continue;
    float values[K];
    basis_from<K>(centre, means + 3 * i, values);
    const float* c = harmonics + 3 * K * i;
    for (int channel = 0; channel < 3; ++channel, c += K) {
      float sum = 0;
      for (int k = 0; k < K; ++k) sum += values[k] * c[k];
      colors[3 * i + channel] += sum;
    }
  }
}

template <int K>
void gradient_of(const std::array<float, 3>& centre, const float* means, const float* by_color,
                 const bool* rows, float* out, ptrdiff_t count, int threads) {
#pragma omp parallel for schedule(static) num_threads(threads)
  for (ptrdiff_t i = 0; i < count; ++i) {
    if (!rows[i]) continue;
    float values[K];
    basis_from<K>(centre, means + 3 * i, values);
    float* o = out + 3 * K * i;
    for (int channel = 0; channel < 3; ++channel, o += K)
      for (int k = 0; k < K; ++k) o[k] = values[k] * by_color[3 * i + channel];
  }
}

// The three degrees by the number of columns, which the caller has made sure of.
template <typename Run>
void by_degree(ptrdiff_t columns, Run run) {
  if (columns == 9) return run(std::integral_constant<int, 3>());
  if (columns == 24) return run(std::integral_constant<int, 8>());
  if (columns == 45) return run(std::integral_constant<int, 15>());
  throw std::invalid_argument("expected 9, 24 or 45 coefficients per Gaussian");
}

void add_colors(std::array<float, 3> centre, Floats means, Floats harmonics, Flags rows,
                Floats colors, int threads) {
  const float *m = means.data(), *h = harmonics.data();
  const bool* r = rows.data();
  float* c = colors.mutable_data();
  const ptrdiff_t count = means.shape(0), columns = harmonics.shape(1);
  py::gil_scoped_release release;
  by_degree(columns, [&](auto k) { colors_of<k()>(centre, m, h, r, c, count, threads); });
}

void gradient(std::array<float, 3> centre, Floats means, Floats by_color, Flags rows, Floats out,
              int threads) {
  const float *m = means.data(), *g = by_color.data();
  const bool* r = rows.data();
  float* o = out.mutable_data();
  const ptrdiff_t count = means.shape(0), columns = out.shape(1);
  py::gil_scoped_release release;
  by_degree(columns, [&](auto k) { gradient_of<k()>(centre, m, g, r, o, count, threads); });
}

}  // namespace

PYBIND11_MODULE(_harmonics, m) {
  m.doc() = "View-dependent colour; use bdgs_ros.mapping.harmonics, which checks its arguments";
  m.def("add_colors", &add_colors);
  m.def("gradient", &gradient);
}
