// Differentiable Gaussian rasteriser for NVIDIA cards: what ../rasterizer.cpp does on a CPU, and a
// whole step of the map's optimisation in which nothing leaves the card.
//
//   prepare    project, sort by depth, deal to tiles          project.cuh, tiles.cuh
//   forward    blend                                          blend.cuh
//   loss       L1, masked SSIM, depth, smoothness             loss.cuh
//   backward   sums per slot, then per Gaussian               blend.cuh
//   update     gradients, or a step of Adam in place          update.cuh
//
// Arguments are addresses in the device's memory, of arrays that the caller owns (torch does);
// bdgs_ros.mapping.cuda checks them. All sums have a fixed order: same input, same result.

#include <array>
#include <limits>

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "update.cuh"

namespace py = pybind11;

namespace bdgs {

using Address = uint64_t;

template <typename T>
T* at(Address address) {
  return reinterpret_cast<T*>(address);
}

inline unsigned blocks_for(size_t threads, unsigned per_block = kPerBlock) {
  return static_cast<unsigned>((threads + per_block - 1) / per_block);
}

// A word that a copy from the device may land in at any time.
class Pinned {
 public:
  Pinned() { check(cudaMallocHost(reinterpret_cast<void**>(&word_), sizeof(*word_)), "memory"); }
  Pinned(const Pinned&) = delete;
  Pinned& operator=(const Pinned&) = delete;
  ~Pinned() { cudaFreeHost(word_); }
  uint32_t* word() const { return word_; }

 private:
  uint32_t* word_ = nullptr;
};

class Rasterizer {
 public:
  void look(const Gaussians& in, const Camera& camera, const double* state, float* planes,
            float* radius, cudaStream_t stream) {
    in_ = in;
    camera_ = camera;
    state_ = state;
    stream_ = stream;
    tiles_x_ = (camera.width + kTile - 1) / kTile;
    tiles_ = tiles_x_ * ((camera.height + kTile - 1) / kTile);
    const size_t size = static_cast<size_t>(camera.width) * camera.height;
    rendered_ = {planes != nullptr ? planes : planes_.reserve(kPlanes * size), size};
    prepare(radius);
    BDGS_LAUNCH(forward_kernel, tiles_, kTilePixels, stream_, dealt(), camera_, rendered_);
  }

  void statistics(float* visibility, float* max_weight) {
    if (in_.count == 0) return;
    float* sums = slot_sums_.reserve(2 * static_cast<size_t>(slots_) + 1);
    BDGS_LAUNCH(statistics_kernel, tiles_, kTilePixels, stream_, dealt(), camera_, sums);
    BDGS_LAUNCH(gather_statistics_kernel, blocks_for(in_.count), kPerBlock, stream_, in_.count,
                first_of_.data(), tiles_of_.data(), sums, visibility, max_weight);
  }

  void compare(const Target& target, const LossWeights& weights) {
    weights_ = weights;
    const size_t size = rendered_.size;
    gradient_ = {gradient_planes_.reserve(kPlanes * size), size};
    double* partial = weight_partials_.reserve(2 * kWeightBlocks);
    float* per_weight = per_weight_.reserve(2);
    BDGS_LAUNCH(weights_kernel, kWeightBlocks, kTilePixels, stream_, target, camera_.width,
                camera_.height, partial);
    BDGS_LAUNCH(scales_kernel, 1, kWarp, stream_, partial, per_weight);
    const LossInput in{target,  camera_, rendered_, state_ + kExposure, per_weight, weights,
                       window_, tiles_x_};
    float* fields = fields_.reserve(kFields * size);
    double* ssim = ssim_partials_.reserve(tiles_);
    double* pixels = pixel_partials_.reserve(static_cast<size_t>(kLossSums) * tiles_);
    BDGS_LAUNCH(ssim_kernel, tiles_, kTilePixels, stream_, in, fields, ssim);
    BDGS_LAUNCH(loss_kernel, tiles_, kTilePixels, stream_, in, fields, gradient_, pixels);
    compared_ = true;
  }

  void given(float* gradient_planes) {
    gradient_ = {gradient_planes, rendered_.size};
    compared_ = false;
    weights_ = {};
  }

  void backward() {
    if (in_.count == 0) return;
    float* sums = slot_sums_.reserve(kSums * static_cast<size_t>(slots_) + 1);
    float* per_gaussian = sums_.reserve(kSums * static_cast<size_t>(in_.count));
    BDGS_LAUNCH(backward_kernel, tiles_, kTilePixels, stream_, dealt(), camera_, rendered_,
                gradient_, sums);
    BDGS_LAUNCH(gather_kernel, blocks_for(kSums * static_cast<size_t>(in_.count)), kPerBlock,
                stream_, in_.count, first_of_.data(), tiles_of_.data(), sums, per_gaussian);
  }

  void gradients(const GradientArrays& out, double* result) {
    if (in_.count > 0)
      BDGS_LAUNCH(gradients_kernel, blocks_for(in_.count), kPerBlock, stream_, in_, camera_,
                  state_ + kPose, tiles_of_.data(), sums_.data(), out, gaussian_partials());
    finish(nullptr, ViewRates{-1, 0, {}, {}}, result);
  }

  void update(const Optimised& optimised, double* state, const ViewRates& rates, double* result) {
    if (in_.count > 0)
      BDGS_LAUNCH(update_kernel, blocks_for(in_.count), kPerBlock, stream_, in_, camera_,
                  state_ + kPose, tiles_of_.data(), sums_.data(), optimised, gaussian_partials());
    finish(state, rates, result);
  }

  uint32_t slots() const { return slots_; }
  size_t bytes() const {
    return planes_.bytes() + gradient_planes_.bytes() + fields_.bytes() + slot_sums_.bytes() +
           sums_.bytes() + records_.bytes() + room_.bytes() + keys_.bytes() + 3 * ids_.bytes() +
           3 * tiles_of_.bytes() + 5 * slot_tile_.bytes();
  }

 private:
  void prepare(float* radius) {
    Range* ranges = ranges_.reserve(tiles_);
    check(cudaMemsetAsync(ranges, 0, tiles_ * sizeof(Range), stream_), "ranges");
    slots_ = 0;
    const int n = in_.count;
    if (n == 0) return;
    const Projected projected{records_.reserve(n), keys_.reserve(n), ids_.reserve(n),
                              tiles_of_.reserve(n)};
    BDGS_LAUNCH(project_kernel, blocks_for(n), kPerBlock, stream_, in_, camera_, state_ + kPose,
                projected, radius);
    sort(projected.keys, sorted_keys_.reserve(n), projected.ids, sorted_ids_.reserve(n), n,
         kDepthBits + 1);
    uint32_t *counts = counts_.reserve(n + 1), *firsts = firsts_.reserve(n + 1);
    BDGS_LAUNCH(order_kernel, blocks_for(n + 1), kPerBlock, stream_, n, sorted_ids_.data(),
                projected.tiles, counts);
    size_t bytes = 0;
    check(cub::DeviceScan::ExclusiveSum(nullptr, bytes, counts, firsts, n + 1, stream_), "scan");
    uint8_t* room = room_.reserve(bytes);
    check(cub::DeviceScan::ExclusiveSum(room, bytes, counts, firsts, n + 1, stream_), "scan");
    check(cudaMemcpyAsync(total_.word(), firsts + n, sizeof(uint32_t), cudaMemcpyDeviceToHost,
                          stream_),
          "number of slots");
    check(cudaStreamSynchronize(stream_), "number of slots");
    slots_ = *total_.word();
    if (slots_ > static_cast<uint32_t>(std::numeric_limits<int>::max()))
      throw std::runtime_error("too many Gaussians in view for the rasteriser");
    deal(projected, firsts);
  }

  void deal(const Projected& projected, const uint32_t* firsts) {
    const uint32_t room = slots_ + 1;
    uint32_t *tile = slot_tile_.reserve(room), *number = slot_number_.reserve(room);
    BDGS_LAUNCH(emit_kernel, blocks_for(in_.count), kPerBlock, stream_, in_.count, tiles_x_,
                sorted_ids_.data(), firsts, projected.tiles, projected.records,
                first_of_.reserve(in_.count), tile, number, slot_gaussian_.reserve(room));
    if (slots_ == 0) return;
    int bits = 1;
    while ((1 << bits) < tiles_) ++bits;
    sort(tile, sorted_tile_.reserve(room), number, sorted_slots_.reserve(room), slots_, bits);
    BDGS_LAUNCH(range_kernel, blocks_for(slots_), kPerBlock, stream_, slots_, sorted_tile_.data(),
                ranges_.data());
  }

  void sort(const uint32_t* keys, uint32_t* keys_out, const uint32_t* values, uint32_t* values_out,
            int count, int bits) {
    size_t bytes = 0;
    check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, keys, keys_out, values, values_out,
                                          count, 0, bits, stream_),
          "sort");
    uint8_t* room = room_.reserve(bytes);
    check(cub::DeviceRadixSort::SortPairs(room, bytes, keys, keys_out, values, values_out, count, 0,
                                          bits, stream_),
          "sort");
  }

  Tiles dealt() const {
    return {records_.data(), ranges_.data(), sorted_slots_.data(), slot_gaussian_.data(), tiles_x_};
  }

  double* gaussian_partials() {
    return gaussian_partials_.reserve(static_cast<size_t>(kPartials) * blocks_for(in_.count));
  }

  void finish(double* state, const ViewRates& rates, double* result) {
    const Partials partials{gaussian_partials_.data(), ssim_partials_.data(),
                            compared_ ? pixel_partials_.data() : nullptr,
                            static_cast<int>(blocks_for(in_.count)), tiles_};
    BDGS_LAUNCH(view_kernel, 1, kTilePixels, stream_, partials, weights_, per_weight_.data(),
                state, rates, result);
  }

  Gaussians in_{};
  Camera camera_{};
  LossWeights weights_{};
  const Window window_{};
  const double* state_ = nullptr;
  cudaStream_t stream_{};
  int tiles_x_ = 0, tiles_ = 0;
  uint32_t slots_ = 0;
  bool compared_ = false;
  Planes rendered_{}, gradient_{};
  Pinned total_;
  Buffer<float> planes_, gradient_planes_, fields_, slot_sums_, sums_, per_weight_;
  Buffer<double> weight_partials_, ssim_partials_, pixel_partials_, gaussian_partials_;
  Buffer<Record> records_;
  Buffer<Range> ranges_;
  Buffer<uint8_t> room_;
  Buffer<uint32_t> keys_, sorted_keys_, ids_, sorted_ids_;              // by Gaussian
  Buffer<uint32_t> tiles_of_, counts_, firsts_, first_of_;              // by Gaussian
  Buffer<uint32_t> slot_tile_, slot_number_, slot_gaussian_, sorted_tile_, sorted_slots_;
};

// ---- Python ------------------------------------------------------------------------------------

using Addresses = std::vector<Address>;

// `arrays`: means, quats, log_scales, logit_opacities, colors, p_dynamic, active or 0.
Gaussians gaussians_of(const Addresses& arrays, int count, float min_logit) {
  if (arrays.size() != 7) throw std::invalid_argument("gaussians: expected seven arrays");
  const auto p = [&](int k) { return at<const float>(arrays[k]); };
  return {p(0), p(1), p(2), p(3), p(4), p(5), at<const uint8_t>(arrays[6]), min_logit, count};
}

Camera camera_of(int width, int height, const std::array<double, 4>& intrinsics) {
  Camera c{};
  c.width = width;
  c.height = height;
  c.fx = static_cast<float>(intrinsics[0]);
  c.fy = static_cast<float>(intrinsics[1]);
  c.cx = static_cast<float>(intrinsics[2]);
  c.cy = static_cast<float>(intrinsics[3]);
  c.set_limits();
  return c;
}

// `arrays`: color, image, scale, depth, weight, still; 0 for what is not given.
Target target_of(const Addresses& arrays, int stride) {
  if (arrays.size() != 6) throw std::invalid_argument("target: expected six arrays");
  return {at<const float>(arrays[0]), at<const uint8_t>(arrays[1]), at<const float>(arrays[2]),
          at<const float>(arrays[3]), at<const float>(arrays[4]),   at<const uint8_t>(arrays[5]),
          stride};
}

LossWeights weights_of(const std::array<float, 5>& w) { return {w[0], w[1], w[2], w[3], w[4]}; }

GradientArrays gradients_of(const Addresses& arrays) {
  if (arrays.size() != 6) throw std::invalid_argument("gradients: expected six arrays");
  const auto p = [&](int k) { return at<float>(arrays[k]); };
  return {p(0), p(1), p(2), p(3), p(4), p(5)};
}

void look(Rasterizer& r, const Addresses& gaussians, int count, float min_logit, int width,
          int height, const std::array<double, 4>& intrinsics, Address state, Address planes,
          Address radius, Address stream) {
  py::gil_scoped_release release;
  r.look(gaussians_of(gaussians, count, min_logit), camera_of(width, height, intrinsics),
         at<const double>(state), at<float>(planes), at<float>(radius),
         reinterpret_cast<cudaStream_t>(stream));
}

void statistics(Rasterizer& r, Address visibility, Address max_weight) {
  py::gil_scoped_release release;
  r.statistics(at<float>(visibility), at<float>(max_weight));
}

void backward(Rasterizer& r, Address gradient_planes, const Addresses& gradients, Address result) {
  py::gil_scoped_release release;
  r.given(at<float>(gradient_planes));
  r.backward();
  r.gradients(gradients_of(gradients), at<double>(result));
}

void compare(Rasterizer& r, const Addresses& target, int stride,
             const std::array<float, 5>& weights, const Addresses& gradients, Address result) {
  py::gil_scoped_release release;
  r.compare(target_of(target, stride), weights_of(weights));
  r.backward();
  r.gradients(gradients_of(gradients), at<double>(result));
}

// `values`, `first`, `second`: the five optimised arrays and their moments; `extra`: penalised,
// dL/dcolor, pull, views, visibility, each or 0; `direct`: weights of the direct terms per pixel.
void step(Rasterizer& r, const Addresses& target, int stride, const std::array<float, 5>& weights,
          const Addresses& values, const Addresses& first, const Addresses& second,
          const std::array<float, 5>& rates, const std::array<float, 2>& direct,
          const Addresses& extra, Address state, const std::array<double, 2>& view_rates,
          Address result) {
  if (extra.size() != 5) throw std::invalid_argument("extra: expected five arrays");
  const Adam usual{0.9f, 0.999f, 1e-15f}, quick{0.9f, 0.99f, 1e-15f};
  Optimised o{};
  for (int k = 0; k < 5; ++k) {
    o.values[k] = at<float>(values.at(k));
    o.first[k] = at<float>(first.at(k));
    o.second[k] = at<float>(second.at(k));
    o.rate[k] = rates[k];
  }
  o.adam = usual;
  o.penalised = at<const uint8_t>(extra[0]);
  o.dynamic = direct[0];
  o.reg = direct[1];
  o.by_color = at<float>(extra[1]);
  o.pull = at<float>(extra[2]);
  o.views = at<float>(extra[3]);
  o.visibility = at<float>(extra[4]);
  py::gil_scoped_release release;
  r.compare(target_of(target, stride), weights_of(weights));
  r.backward();
  r.update(o, at<double>(state), ViewRates{view_rates[0], view_rates[1], quick, usual},
           at<double>(result));
}

}  // namespace bdgs

#ifndef BDGS_MODULE
#define BDGS_MODULE _rasterizer_cuda
#endif

PYBIND11_MODULE(BDGS_MODULE, m) {
  using namespace bdgs;
  m.doc() = "Gaussian rasteriser for CUDA; use bdgs_ros.mapping.cuda, which checks its arguments";
  m.attr("VIEW_STATE") = static_cast<int>(kViewState);
  m.attr("RESULTS") = static_cast<int>(kResults);
  py::class_<Rasterizer>(m, "Rasterizer", py::module_local())
      .def(py::init<>())
      .def("look", &look)
      .def("statistics", &statistics)
      .def("backward", &backward)
      .def("compare", &compare)
      .def("step", &step)
      .def_property_readonly("slots", &Rasterizer::slots)
      .def_property_readonly("bytes", &Rasterizer::bytes);
}
