// Planes through the pixels of a depth image: the fast twin of bdgs_ros/mapping/surface.py, which
// says what it is and has the derivation of every line.

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

namespace py = pybind11;

namespace {

using Floats = py::array_t<float, py::array::c_style>;
using Flags = py::array_t<bool, py::array::c_style>;

constexpr int kTerms = 10;  // w, wx, wy, wq, wxx, wxy, wyy, wxq, wyq, wqq
constexpr double kMinShare = 0.4, kLeastSpread = 0.05;

using Sums = std::array<double, kTerms>;

struct Image {
  int height, width;
  const float *q, *rays, *limit;  // inverse depth, 0 = does not take part; [H, W, 3]; in 1/m
  const bool* wanted;
};

struct Result {
  float *normals, *inverse_depth;
  bool* flat;
};

struct Plane {
  double a, b, c, rms;
};

// Adds what a row of pixels says to the sums of their columns, or takes it away again.
void add_row(const Image& image, int row, double sign, std::vector<Sums>& columns) {
  const float* q = image.q + static_cast<size_t>(row) * image.width;
  const float* ray = image.rays + 3 * static_cast<size_t>(row) * image.width;
  for (int u = 0; u < image.width; ++u, ray += 3) {
    if (!(q[u] > 0)) continue;
    const double x = ray[0], y = ray[1], z = q[u];
    const Sums terms = {1, x, y, z, x * x, x * y, y * y, x * z, y * z, z * z};
    for (int k = 0; k < kTerms; ++k) columns[u][k] += sign * terms[k];
  }
}

Plane fit(const Sums& sums, double least) {
  const double n = 1 / sums[0];
  const double mx = sums[1] * n, my = sums[2] * n, mq = sums[3] * n;
  const double sxx = sums[4] * n - mx * mx, sxy = sums[5] * n - mx * my,
               syy = sums[6] * n - my * my;
  const double sqx = sums[7] * n - mq * mx, sqy = sums[8] * n - mq * my,
               sqq = sums[9] * n - mq * mq;
  const double once = 1 / std::max(sxx * syy - sxy * sxy, least);
  const double a = (syy * sqx - sxy * sqy) * once, b = (sxx * sqy - sxy * sqx) * once;
  return {a, b, mq - a * mx - b * my, std::sqrt(std::max(sqq - a * sqx - b * sqy, 0.0))};
}

// Takes the plane of a window as that of its central pixel, where it fits.
void judge(const Image& image, size_t at, const Sums& sums, double pixels, double least,
           const Result& result) {
  if (!image.wanted[at] || result.flat[at] || !(image.q[at] > 0)) return;
  if (sums[0] < kMinShare * pixels) return;
  const Plane plane = fit(sums, least);
  const float* ray = image.rays + 3 * at;
  const double there = plane.a * ray[0] + plane.b * ray[1] + plane.c;
  const double limit = image.limit[at];
  if (!(plane.rms < limit && std::abs(there - image.q[at]) < 2 * limit)) return;
  const double once = -1 / std::sqrt(plane.a * plane.a + plane.b * plane.b + plane.c * plane.c);
  result.flat[at] = true;
  result.inverse_depth[at] = static_cast<float>(there);
  result.normals[3 * at] = static_cast<float>(once * plane.a);
  result.normals[3 * at + 1] = static_cast<float>(once * plane.b);
  result.normals[3 * at + 2] = static_cast<float>(once * plane.c);
}

void fit_windows(const Image& image, int radius, double least, const Result& result) {
  const int height = image.height, width = image.width;
  const double pixels = (2.0 * radius + 1) * (2.0 * radius + 1);
  std::vector<Sums> columns(width, Sums{});
  for (int row = 0; row < std::min(radius, height); ++row) add_row(image, row, 1, columns);
  for (int row = 0; row < height; ++row) {
    if (row + radius < height) add_row(image, row + radius, 1, columns);
    if (row - radius > 0) add_row(image, row - radius - 1, -1, columns);
    const size_t first = static_cast<size_t>(row) * width;
    if (std::none_of(image.wanted + first, image.wanted + first + width, [](bool w) { return w; }))
      continue;
    Sums sums{};
    const auto add = [&](int u, double sign) {
      for (int k = 0; k < kTerms; ++k) sums[k] += sign * columns[u][k];
    };
    for (int u = 0; u < std::min(radius, width); ++u) add(u, 1);
    for (int u = 0; u < width; ++u) {
      if (u + radius < width) add(u + radius, 1);
      if (u - radius > 0) add(u - radius - 1, -1);
      judge(image, first + u, sums, pixels, least, result);
    }
  }
}

void fit_planes(Floats inverse_depth, Floats rays, Floats limit, Flags wanted, double fx,
                const std::vector<int>& radii, Floats normals, Floats plane_depth, Flags flat) {
  const Image image = {static_cast<int>(inverse_depth.shape(0)),
                       static_cast<int>(inverse_depth.shape(1)),
                       inverse_depth.data(),
                       rays.data(),
                       limit.data(),
                       wanted.data()};
  const Result result = {normals.mutable_data(), plane_depth.mutable_data(), flat.mutable_data()};
  py::gil_scoped_release release;
  for (const int radius : radii) {
    const double spread = radius * (radius + 1) / (3 * fx * fx);
    const double least = kLeastSpread * spread;
    fit_windows(image, radius, least * least, result);
  }
}

}  // namespace

PYBIND11_MODULE(_surface, m) {
  m.doc() = "Planes in depth images; use bdgs_ros.mapping.surface, which checks its arguments";
  m.def("fit_planes", &fit_planes);
}
