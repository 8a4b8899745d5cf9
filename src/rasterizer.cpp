// Differentiable Gaussian rasteriser for CPUs: forward, loss and backward.
//
// What it computes. Each Gaussian projects to an ellipse (rasterizer_project.hpp). Front to back
// over the Gaussians i that cover a pixel, with d the offset from the ellipse's centre in px:
//
//   alpha_i = min(0.99, o_i exp(-1/2 d^T S_i^-1 d))      skipped below 1/255
//   w_i     = alpha_i T_i,  T_{i+1} = T_i (1 - alpha_i),  T_0 = 1,  stop once T_i < 1e-4
//   color   = sum w_i c_i      depth = sum w_i (z_i + zeta_i . d)
//   silhouette = sum w_i       dynamic = sum w_i p_i
//
// The depth is where the pixel's ray meets the Gaussian, not the z of its centre: the mean of its
// z given the pixel (rasterizer_project.hpp), so that a slanted wall renders as a slanted wall.
//
// How it is laid out. The image is cut into tiles of 16 x 16 px and those into blocks of kLanes
// pixels (4 x 4 with AVX-512, else 4 x 2): one vector is one block.
//
//   prepare   kLanes Gaussians at a time: project, write a 64-byte Record and a pixel Box
//             (half widths sqrt(S_kk 2 ln(255 o)): exactly where alpha >= 1/255). Radix-sort the
//             visible by depth, once, then deal them in that order to the tiles they touch. A
//             (tile, Gaussian) pair is a *slot*.
//   forward   per tile: copy its records next to each other and deal them to the blocks they
//             touch. Per block: walk its list with T, colour, depth ... in registers. Alphas are
//             kept for the way back, but only for pairs in which some pixel was touched. A block
//             whose pixels are all opaque stops.
//   loss      L1, masked SSIM, depth, smoothness, exposure: gradient planes (rasterizer_loss.hpp).
//   backward  per block, front to back again with the kept alphas. With u_i = dL/dw_i (colour,
//             depth and silhouette gradients of the pixel dotted with the Gaussian's) and R_i =
//             sum_{j > i} w_j u_j, which is the pixel's total minus what has been walked:
//                 dL/dalpha_i = T_i u_i - R_i / (1 - alpha_i)
//             All a Gaussian needs of a block are linear functions of two vectors, w and
//             g = alpha dL/dalpha: six moments of g and seven sums of w. So the block's pixel
//             coordinates and gradients form a matrix with one row of 16 outputs per pixel, and
//             the reduction over pixels is a matrix product instead of 13 horizontal sums.
//             Sums go to the tile's slots. Walking hangs on T and R from pair to pair, products on
//             nothing: they take turns, a few pairs at a time, so that neither waits.
//   gather    per Gaussian: add its slots in order, and go back through the projection.
//
// Every sum has a fixed order (slots per Gaussian, chunks for the pose, rows for the loss), so the
// result is the same to the last bit for any number of threads. All memory is kept between calls.

#include <algorithm>
#include <array>
#include <stdexcept>
#include <string>
#include <vector>

#include <omp.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "rasterizer_adam.hpp"
#include "rasterizer_loss.hpp"
#include "rasterizer_project.hpp"
#include "rasterizer_simd.hpp"

namespace py = pybind11;

namespace bdgs {

constexpr int kTile = 16;
constexpr int kBlockWidth = 4, kBlockHeight = kLanes / kBlockWidth;
constexpr int kBlocksX = kTile / kBlockWidth, kBlocksY = kTile / kBlockHeight;
constexpr int kBlocks = kBlocksX * kBlocksY;
constexpr float kMaxAlpha = 0.99f, kMinTransmittance = 1e-4f;
constexpr float kTileCentre = 0.5f * (kTile - 1);
constexpr int kOutputs = 16;  // floats per slot
constexpr int kBatch = 8;     // pairs walked before their products are formed
constexpr uint32_t kCulled = 0xffffffffu;
constexpr int kAhead = 24;     // how many elements ahead of its use memory is asked for
constexpr int kRadixBits = 12, kRadix = 1 << kRadixBits;

// What the pixels of a slot add up to: sums over g at even places, over w at odd ones.
enum Output {
  kG = 0, kGx = 2, kGy = 4, kGxx = 6, kGxy = 8, kGyy = 10,
  kSumRed = 1, kSumDepth = 7, kSumDepthX = 9, kSumDepthY = 11, kSumWeight = 13
};

struct Box {  // pixels, inclusive
  uint16_t x0, x1, y0, y1;

  int tiles() const {
    return (x1 / kTile - x0 / kTile + 1) * (y1 / kTile - y0 / kTile + 1);
  }
};

// alpha = exp2(l + a dx^2 + b dx dy + c dy^2), and what is blended with it.
struct alignas(64) Record {
  float u, v, a, b, c, l, red, green, blue, z, zeta_u, zeta_v, p_dynamic;
  Box box;
  float unused;
};
static_assert(sizeof(Record) == 64, "one cache line");

struct Entry {
  uint32_t key, id;
};

// Where a block's forward pass left its alphas.
struct Kept {
  uint32_t thread, count;
  size_t first;
};

struct Arena {
  Buffer<float> alphas;    // kLanes per kept pair
  Buffer<uint32_t> locals; // position in the tile's list
  size_t size = 0;
};

struct TileScratch {
  Buffer<Record> records;
  Buffer<uint32_t> masks, lists;
  Buffer<float> sums;
};

struct GradientArrays {  // any may be null
  float *means, *quats, *log_scales, *logit_opacities, *colors, *visibility;
  double* pose;
};

struct Statistics {  // per Gaussian, null: not wanted
  float *visibility, *max_weight, *radius;
};

class Rasterizer {
 public:
  void render(const Parameters& in, const View& view, int threads, const Statistics& stats) {
    prepare(in, view, threads, stats.radius);
    const bool wanted = stats.visibility != nullptr;
    if (wanted) slot_sums_.reserve(slots_ * kOutputs);
    forward(threads, wanted);
    if (wanted) gather_statistics(in.count, stats, threads);
  }

  void backward(const Parameters& in, const View& view, int threads, const GradientArrays& out) {
    slot_sums_.reserve(slots_ * kOutputs);
    const int tiles = tiles_x_ * tiles_y_;
#pragma omp parallel for schedule(dynamic, 2) num_threads(threads)
    for (int tile = 0; tile < tiles; ++tile) backward_tile(tile);
    gather(in, view, threads, out);
  }

  LossResult loss(const LossInput& in, int threads) {
    return loss_.compute(layout_, planes_.data(), in, threads);
  }

  const Layout& layout() const { return layout_; }
  float* plane(int which) { return planes_.data() + which * layout_.plane; }
  size_t slots() const { return slots_; }
  size_t kept_pairs() const {
    size_t total = 0;
    for (const Arena& arena : arenas_) total += arena.size;
    return total;
  }

 private:
  // ---- prepare ---------------------------------------------------------------------------------

  void prepare(const Parameters& in, const View& view, int threads, float* radius) {
    set_size(view, threads);
    records_.reserve(in.count);
    boxes_.reserve(in.count);
    keys_.reserve(in.count);
    const int groups = (in.count + kLanes - 1) / kLanes;
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int group = 0; group < groups; ++group) project_group(in, view, group * kLanes, radius);
    sort_by_depth(in.count);
    deal_to_tiles(in.count, threads);
  }

  void set_size(const View& view, int threads) {
    if (view.width != layout_.width || view.height != layout_.height) {
      layout_ = Layout(view.width, view.height);
      planes_.reserve(kPlanes * layout_.plane);
      std::memset(planes_.data(), 0, kPlanes * layout_.plane * sizeof(float));
      tiles_x_ = (view.width + kTile - 1) / kTile;
      tiles_y_ = (view.height + kTile - 1) / kTile;
      tile_first_.reserve(tiles_x_ * tiles_y_ + 1);
      kept_.reserve(static_cast<size_t>(tiles_x_) * tiles_y_ * kBlocks);
    }
    if (arenas_.size() < static_cast<size_t>(threads)) {
      arenas_.resize(threads);
      scratch_.resize(threads);
    }
  }

  void project_group(const Parameters& in, const View& view, int i, float* radius) {
    const int lanes = std::min(kLanes, in.count - i);
    Ellipses e;
    transform_means(in, i, view, e);
    Mask visible = e.z > kNear;
    for (int lane = 0; lane < kLanes; ++lane)
      if (lane >= lanes || (in.active != nullptr && !in.active[i + lane])) visible[lane] = 0;
    if (!any(visible)) {
      for (int lane = 0; lane < lanes; ++lane) keys_[i + lane] = kCulled;
      if (radius != nullptr) std::fill_n(radius + i, lanes, 0.0f);
      return;
    }
    project(in, i, view, e);
    const Lanes l = log2(max(e.opacity, splat(1e-30f)));
    const Lanes reach = max((2.0f * kLn2) * (l - std::log2(kMinAlpha)), Lanes{});
    const Lanes half_x = sqrt(e.s00 * reach), half_y = sqrt(e.s11 * reach);
    // comparisons that a NaN fails
    visible &= (reach > 0.0f) & (e.u + half_x >= 0.0f) & (e.u - half_x <= view.width - 1.0f) &
               (e.v + half_y >= 0.0f) & (e.v - half_y <= view.height - 1.0f) &
               (e.inverse_det > 0.0f) & (half_x < 1e6f) & (half_y < 1e6f);
    write_records(in, view, i, lanes, e, l, visible, half_x, half_y);
    if (radius != nullptr) {
      const Lanes larger = max(half_x, half_y);
      for (int lane = 0; lane < lanes; ++lane)
        radius[i + lane] = keys_[i + lane] == kCulled ? 0.0f : larger[lane];
    }
  }

  void write_records(const Parameters& in, const View& view, int i, int lanes, const Ellipses& e,
                     Lanes l, Mask visible, Lanes half_x, Lanes half_y) {
    // ceil of the lower and floor of the upper bound, widened a little against rounding
    const float slack = 1e-3f;
    const Lanes zero = Lanes{};
    const Lanes last_x = splat(view.width - 1.0f), last_y = splat(view.height - 1.0f);
    const Lanes x0 = min(max(e.u - half_x - slack + 1.0f, zero), last_x + 1.0f);
    const Lanes x1 = min(max(e.u + half_x + slack, splat(-1.0f)), last_x);
    const Lanes y0 = min(max(e.v - half_y - slack + 1.0f, zero), last_y + 1.0f);
    const Lanes y1 = min(max(e.v + half_y + slack, splat(-1.0f)), last_y);
    const Mask first_x = __builtin_convertvector(x0, Mask);
    const Mask final_x = __builtin_convertvector(x1, Mask);
    const Mask first_y = __builtin_convertvector(y0, Mask);
    const Mask final_y = __builtin_convertvector(y1, Mask);
    visible &= (first_x <= final_x) & (first_y <= final_y) & (x1 >= 0.0f) & (y1 >= 0.0f);
    // positive floats sort like their bits; eight units of the last place are 1e-6 relative
    const Mask key = (bits_of(e.z) - bits_of(splat(kNear))) >> 3;

    const Lanes scale = (-0.5f * kLog2E) * e.inverse_det;
    alignas(64) float fields[9][kLanes];
    store(fields[0], e.u);
    store(fields[1], e.v);
    store(fields[2], scale * e.s11);
    store(fields[3], -2.0f * scale * e.s01);
    store(fields[4], scale * e.s00);
    store(fields[5], l);
    store(fields[6], e.z);
    store(fields[7], e.zeta_u);
    store(fields[8], e.zeta_v);
    for (int lane = 0; lane < lanes; ++lane) {
      const size_t id = i + lane;
      const float* color = in.colors + 3 * id;
      const float blended = color[0] + color[1] + color[2] + in.p_dynamic[id];
      if (!visible[lane] || !(std::fabs(blended) < 1e30f)) {  // one NaN would fill the tile
        keys_[id] = kCulled;
        continue;
      }
      keys_[id] = std::min<int32_t>(int32_t{key[lane]}, kRadix * kRadix - 1);
      const Box box = {static_cast<uint16_t>(first_x[lane]), static_cast<uint16_t>(final_x[lane]),
                       static_cast<uint16_t>(first_y[lane]), static_cast<uint16_t>(final_y[lane])};
      boxes_[id] = box;
      Record& r = records_[id];
      r.box = box;
      r.u = fields[0][lane];
      r.v = fields[1][lane];
      r.a = fields[2][lane];
      r.b = fields[3][lane];
      r.c = fields[4][lane];
      r.l = fields[5][lane];
      r.red = color[0];
      r.green = color[1];
      r.blue = color[2];
      r.z = fields[6][lane];
      r.zeta_u = fields[7][lane];
      r.zeta_v = fields[8][lane];
      r.p_dynamic = in.p_dynamic[id];
    }
  }

  // Visible Gaussians, near to far; equal depths keep the order of the arrays.
  void sort_by_depth(int count) {
    Entry* entries = entries_.reserve(count + 1);
    Entry* spare = spare_.reserve(count + 1);
    std::vector<uint32_t>& low = low_;
    std::vector<uint32_t>& high = high_;
    low.assign(kRadix + 1, 0);
    high.assign(kRadix + 1, 0);
    visible_ = 0;
    for (int i = 0; i < count; ++i) {
      entries[visible_] = {keys_[i], static_cast<uint32_t>(i)};
      visible_ += keys_[i] != kCulled;
    }
    for (size_t s = 0; s < visible_; ++s) {
      ++low[(entries[s].key & (kRadix - 1)) + 1];
      ++high[(entries[s].key >> kRadixBits) + 1];
    }
    for (int k = 0; k < kRadix; ++k) {
      low[k + 1] += low[k];
      high[k + 1] += high[k];
    }
    for (size_t s = 0; s < visible_; ++s)
      spare[low[entries[s].key & (kRadix - 1)]++] = entries[s];
    for (size_t s = 0; s < visible_; ++s) entries[high[spare[s].key >> kRadixBits]++] = spare[s];
  }

  // Make the slots, tile by tile and near to far within a tile. Each thread deals a stretch of
  // the sorted Gaussians and knows how many the stretches before its own put into each tile.
  void deal_to_tiles(int count, int threads) {
    const int tiles = tiles_x_ * tiles_y_;
    number_slots(count);
    slot_gaussian_.reserve(slots_ + 16);
    slots_of_.reserve(slots_ + 1);
    tile_next_.reserve(static_cast<size_t>(threads) * tiles);
#pragma omp parallel num_threads(threads)
    {
      const int thread = omp_get_thread_num(), team = omp_get_num_threads();
      const size_t begin = visible_ * thread / team, end = visible_ * (thread + 1) / team;
      uint32_t* next = tile_next_.data() + static_cast<size_t>(thread) * tiles;
      std::fill_n(next, tiles, 0u);
      for_each_tile(begin, end, [&](uint32_t, int tile) { ++next[tile]; });
#pragma omp barrier
#pragma omp single
      number_tiles(tiles, team);
      for_each_tile(begin, end, [&](uint32_t id, int tile) {
        const uint32_t slot = next[tile]++;
        slot_gaussian_[slot] = id;
        slots_of_[slot_next_[id]++] = slot;
      });
    }
  }

  // first_slot_[i] .. first_slot_[i + 1] are Gaussian i's places in slots_of_.
  void number_slots(int count) {
    first_slot_.reserve(count + 3 * kLanes + 1);
    slot_next_.reserve(count + 1);
    uint32_t used = 0;
    for (int i = 0; i < count; ++i) {
      first_slot_[i] = slot_next_[i] = used;
      used += keys_[i] == kCulled ? 0 : boxes_[i].tiles();
    }
    std::fill_n(first_slot_.data() + count, 3 * kLanes + 1, used);
    slots_ = used;
  }

  // From counts per thread and tile to the first slot of each.
  void number_tiles(int tiles, int team) {
    uint32_t used = 0;
    for (int tile = 0; tile < tiles; ++tile) {
      tile_first_[tile] = used;
      for (int thread = 0; thread < team; ++thread) {
        uint32_t& next = tile_next_[static_cast<size_t>(thread) * tiles + tile];
        const uint32_t here = next;
        next = used;
        used += here;
      }
    }
    tile_first_[tiles] = used;
  }

  template <typename Visit>
  void for_each_tile(size_t begin, size_t end, Visit visit) {
    for (size_t s = begin; s < end; ++s) {
      __builtin_prefetch(&boxes_[entries_[std::min(s + kAhead, end - 1)].id]);
      const uint32_t id = entries_[s].id;
      const Box box = boxes_[id];
      for (int ty = box.y0 / kTile; ty <= box.y1 / kTile; ++ty)
        for (int tx = box.x0 / kTile; tx <= box.x1 / kTile; ++tx)
          visit(id, ty * tiles_x_ + tx);
    }
  }

  // ---- forward ---------------------------------------------------------------------------------

  void forward(int threads, bool statistics) {
    for (Arena& arena : arenas_) arena.size = 0;
    const int tiles = tiles_x_ * tiles_y_;
#pragma omp parallel for schedule(dynamic, 2) num_threads(threads)
    for (int tile = 0; tile < tiles; ++tile) {
      if (statistics)
        forward_tile<true>(tile);
      else
        forward_tile<false>(tile);
    }
  }

  // Copy a tile's records side by side, centres relative to the tile's; z is that at the tile's.
  int collect_tile(int tile, TileScratch& scratch) {
    const int first = tile_first_[tile], n = tile_first_[tile + 1] - first;
    const float x0 = kTile * (tile % tiles_x_) + kTileCentre;
    const float y0 = kTile * (tile / tiles_x_) + kTileCentre;
    Record* local = scratch.records.reserve(n);
    const uint32_t* ids = slot_gaussian_.data() + first;
    for (int j = 0; j < n; ++j) {
      __builtin_prefetch(&records_[ids[std::min(j + kAhead, n - 1)]]);
      Record& r = local[j];
      r = records_[ids[j]];
      r.u -= x0;
      r.v -= y0;
      r.z -= r.zeta_u * r.u + r.zeta_v * r.v;
    }
    return n;
  }

  // Deal the tile's Gaussians, in order, to the blocks their boxes touch.
  void deal_to_blocks(int tile, int n, TileScratch& scratch, int* counts) {
    const int x0 = kTile * (tile % tiles_x_), y0 = kTile * (tile / tiles_x_);
    uint32_t* lists = scratch.lists.reserve(static_cast<size_t>(n) * kBlocks);
    std::fill_n(counts, kBlocks, 0);
    for (int j = 0; j < n; ++j) {
      const Box box = scratch.records[j].box;
      const int bx0 = std::max(box.x0 - x0, 0) / kBlockWidth;
      const int bx1 = std::min(box.x1 - x0, kTile - 1) / kBlockWidth;
      const int by0 = std::max(box.y0 - y0, 0) / kBlockHeight;
      const int by1 = std::min(box.y1 - y0, kTile - 1) / kBlockHeight;
      for (int by = by0; by <= by1; ++by)
        for (int bx = bx0; bx <= bx1; ++bx) {
          const int block = by * kBlocksX + bx;
          lists[static_cast<size_t>(block) * n + counts[block]++] = j;
        }
    }
  }

  template <bool kStatistics>
  void forward_tile(int tile) {
    const int thread = omp_get_thread_num();
    TileScratch& scratch = scratch_[thread];
    Arena& arena = arenas_[thread];
    const int n = collect_tile(tile, scratch);
    int counts[kBlocks];
    deal_to_blocks(tile, n, scratch, counts);
    if (kStatistics) {
      scratch.sums.reserve(2 * static_cast<size_t>(n) + 1);
      std::fill_n(scratch.sums.data(), 2 * n, 0.0f);
    }
    for (int block = 0; block < kBlocks; ++block) {
      const size_t room = arena.size + counts[block] + 1;
      arena.alphas.reserve(room * kLanes, arena.size * kLanes);
      arena.locals.reserve(room, arena.size);
      Kept& kept = kept_[static_cast<size_t>(tile) * kBlocks + block];
      kept.thread = thread;
      kept.first = arena.size;
      kept.count = forward_block<kStatistics>(
          tile, block, scratch, scratch.lists.data() + static_cast<size_t>(block) * n,
          counts[block], arena.alphas.data() + arena.size * kLanes,
          arena.locals.data() + arena.size);
      arena.size += kept.count;
    }
    if (kStatistics)
      for (int j = 0; j < n; ++j) {
        float* slot = &slot_sums_[static_cast<size_t>(tile_first_[tile] + j) * kOutputs];
        slot[0] = scratch.sums[2 * j];
        slot[1] = scratch.sums[2 * j + 1];
      }
  }

  // Returns the number of kept pairs.
  template <bool kStatistics>
  int forward_block(int tile, int block, TileScratch& scratch, const uint32_t* list, int count,
                    float* alphas, uint32_t* locals) {
    const Record* records = scratch.records.data();
    const Lanes px = pixel_x(block), py = pixel_y(block);
    Lanes T = splat(1.0f), red = {}, green = {}, blue = {}, depth = {}, dynamic = {};
    int kept = 0;
    for (int k = 0; k < count; ++k) {
      const Record& r = records[list[k]];
      const Lanes dx = px - r.u, dy = py - r.v;
      const Lanes power = r.l + dx * (r.a * dx + r.b * dy) + (r.c * dy) * dy;
      Lanes alpha = exp2(max(power, splat(-20.0f)));
      const Mask open = T >= kMinTransmittance;
      alpha = (open & (alpha >= kMinAlpha)) ? min(alpha, splat(kMaxAlpha)) : Lanes{};
      const Lanes w = alpha * T;
      T -= w;
      red += w * r.red;
      green += w * r.green;
      blue += w * r.blue;
      depth += w * (r.z + r.zeta_u * px + r.zeta_v * py);
      dynamic += w * r.p_dynamic;
      if (kStatistics) {
        scratch.sums[2 * list[k]] += sum(w);
        float& best = scratch.sums[2 * list[k] + 1];
        best = std::max(best, largest(w));
      }
      store(alphas + static_cast<size_t>(kept) * kLanes, alpha);
      locals[kept] = list[k];
      kept += any(alpha > 0.0f);
      if (!any(open)) break;
    }
    const size_t at = block_offset(tile, block);
    store_block(plane(kRed) + at, red);
    store_block(plane(kGreen) + at, green);
    store_block(plane(kBlue) + at, blue);
    store_block(plane(kDepth) + at, depth);
    store_block(plane(kSilhouette) + at, 1.0f - T);
    store_block(plane(kDynamic) + at, dynamic);
    return kept;
  }

  static Lanes pixel_x(int block) {
    Lanes v;
    for (int l = 0; l < kLanes; ++l)
      v[l] = block % kBlocksX * kBlockWidth + l % kBlockWidth - kTileCentre;
    return v;
  }

  static Lanes pixel_y(int block) {
    Lanes v;
    for (int l = 0; l < kLanes; ++l)
      v[l] = block / kBlocksX * kBlockHeight + l / kBlockWidth - kTileCentre;
    return v;
  }

  size_t block_offset(int tile, int block) const {
    return layout_.at(kTile * (tile / tiles_x_) + block / kBlocksX * kBlockHeight,
                      kTile * (tile % tiles_x_) + block % kBlocksX * kBlockWidth);
  }

  void store_block(float* to, Lanes v) const {
    for (int row = 0; row < kBlockHeight; ++row)
      std::memcpy(to + row * layout_.stride,
                  reinterpret_cast<const char*>(&v) + row * kBlockWidth * sizeof(float),
                  kBlockWidth * sizeof(float));
  }

  Lanes load_block(const float* from) const {
    alignas(64) float v[kLanes];
    for (int row = 0; row < kBlockHeight; ++row)
      std::memcpy(v + row * kBlockWidth, from + row * layout_.stride,
                  kBlockWidth * sizeof(float));
    return load(v);
  }

  // ---- backward --------------------------------------------------------------------------------

  void backward_tile(int tile) {
    TileScratch& scratch = scratch_[omp_get_thread_num()];
    const int n = collect_tile(tile, scratch);
    float* sums = scratch.sums.reserve(static_cast<size_t>(n) * kOutputs);
    std::fill_n(sums, static_cast<size_t>(n) * kOutputs, 0.0f);
    for (int block = 0; block < kBlocks; ++block) {
      const Kept& kept = kept_[static_cast<size_t>(tile) * kBlocks + block];
      if (kept.count > 0) backward_block(tile, block, kept, scratch.records.data(), sums);
    }
    float* slots = slot_sums_.data() + static_cast<size_t>(tile_first_[tile]) * kOutputs;
    for (int j = 0; j < n; ++j)
      centre_moments(sums + j * kOutputs, scratch.records[j], slots + j * kOutputs);
  }

  // One row per pixel: its powers of x and y for g, its gradients and 1 for w.
  struct alignas(64) Matrix {
    float row[kLanes][kOutputs];
  };

  void backward_block(int tile, int block, const Kept& kept, const Record* records, float* sums) {
    const size_t at = block_offset(tile, block);
    const Lanes g_red = load_block(plane(kGradRed) + at);
    const Lanes g_green = load_block(plane(kGradGreen) + at);
    const Lanes g_blue = load_block(plane(kGradBlue) + at);
    const Lanes g_depth = load_block(plane(kGradDepth) + at);
    const Lanes g_silhouette = load_block(plane(kGradSilhouette) + at);
    const Lanes px = pixel_x(block), py = pixel_y(block);
    const Lanes g_depth_x = g_depth * px, g_depth_y = g_depth * py;
    const Lanes one = splat(1.0f), none = Lanes{};
    const Lanes columns[kOutputs] = {one,     g_red,   px,      g_green,   py,      g_blue,
                                     px * px, g_depth, px * py, g_depth_x, py * py, g_depth_y,
                                     none,    one,     none,    none};
    Matrix matrix;
    for (int k = 0; k < kOutputs; k += kLanes) transpose(columns + k, matrix.row[0] + k, kOutputs);
    Lanes rest = g_red * load_block(plane(kRed) + at) + g_green * load_block(plane(kGreen) + at) +
                 g_blue * load_block(plane(kBlue) + at) +
                 g_depth * load_block(plane(kDepth) + at) +
                 g_silhouette * load_block(plane(kSilhouette) + at);
    Lanes T = splat(1.0f);
    const float* alphas = arenas_[kept.thread].alphas.data() + kept.first * kLanes;
    const uint32_t* locals = arenas_[kept.thread].locals.data() + kept.first;
    alignas(64) double pairs[kBatch][kLanes];
    for (uint32_t done = 0; done < kept.count; done += kBatch) {
      const uint32_t n = std::min<uint32_t>(kBatch, kept.count - done);
      for (uint32_t k = 0; k < n; ++k) {
        const Record& r = records[locals[done + k]];
        const Lanes alpha = load(alphas + static_cast<size_t>(done + k) * kLanes);
        const Lanes w = alpha * T;
        const Lanes u = g_red * r.red + g_green * r.green + g_blue * r.blue + g_depth * r.z +
                        g_depth_x * r.zeta_u + g_depth_y * r.zeta_v + g_silhouette;
        rest -= w * u;
        // g = alpha dL/dalpha; a clamped alpha does not move with the Gaussian
        Lanes g = w * u - alpha * rest * reciprocal(1.0f - alpha);
        g = alpha < kMaxAlpha ? g : Lanes{};
        T -= w;
        interleave(g, w, pairs[k]);
      }
      for (uint32_t k = 0; k < n; ++k)
        add_product(matrix, pairs[k], sums + static_cast<size_t>(locals[done + k]) * kOutputs);
    }
  }

  // out += g . matrix at even places, w . matrix at odd ones.
  static void add_product(const Matrix& matrix, const double* pairs, float* out) {
    constexpr int kParts = kOutputs / kLanes;
    Lanes sums[kParts], more[kParts] = {};
    for (int part = 0; part < kParts; ++part) sums[part] = load(out + part * kLanes);
#pragma GCC unroll 16
    for (int l = 0; l < kLanes; ++l) {
      const Lanes pair = splat_pair(pairs[pair_place(l)]);
      Lanes* to = l < kLanes / 2 ? sums : more;
      for (int part = 0; part < kParts; ++part)
        to[part] += pair * load(matrix.row[l] + part * kLanes);
    }
    for (int part = 0; part < kParts; ++part)
      store(out + part * kLanes, sums[part] + more[part]);
  }

  // Moments about the tile's centre to moments about the Gaussian's.
  static void centre_moments(const float* in, const Record& r, float* out) {
    const float g = in[kG], x = in[kGx], y = in[kGy], u = r.u, v = r.v;
    std::memcpy(out, in, kOutputs * sizeof(float));
    out[kGx] = x - u * g;
    out[kGy] = y - v * g;
    out[kGxx] = in[kGxx] - u * (2.0f * x - u * g);
    out[kGxy] = in[kGxy] - u * y - v * (x - u * g);
    out[kGyy] = in[kGyy] - v * (2.0f * y - v * g);
    out[kSumDepthX] = in[kSumDepthX] - u * in[kSumDepth];
    out[kSumDepthY] = in[kSumDepthY] - v * in[kSumDepth];
  }

  // ---- gather ----------------------------------------------------------------------------------

  static constexpr int kChunk = 64 * kLanes;

  void gather(const Parameters& in, const View& view, int threads, const GradientArrays& out) {
    const int chunks = (in.count + kChunk - 1) / kChunk;
    pose_sums_.reserve(6 * static_cast<size_t>(chunks) + 1);
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int chunk = 0; chunk < chunks; ++chunk) {
      double pose[6] = {};
      const int last = std::min((chunk + 1) * kChunk, in.count);
      for (int i = chunk * kChunk; i < last; i += kLanes) gather_group(in, view, i, out, pose);
      std::memcpy(&pose_sums_[6 * static_cast<size_t>(chunk)], pose, sizeof(pose));
    }
    std::fill_n(out.pose, 6, 0.0);
    for (int chunk = 0; chunk < chunks; ++chunk)
      for (int k = 0; k < 6; ++k) out.pose[k] += pose_sums_[6 * static_cast<size_t>(chunk) + k];
  }

  // Sum the slots of Gaussians i .. i + kLanes - 1; false if none has any.
  bool sum_slots(int i, Moments& m) {
    // first_slot_ goes on beyond the last Gaussian
    for (uint32_t s = first_slot_[i + 2 * kLanes]; s < first_slot_[i + 3 * kLanes]; ++s)
      __builtin_prefetch(&slot_sums_[static_cast<size_t>(slots_of_[s]) * kOutputs]);
    if (first_slot_[i] == first_slot_[i + kLanes]) return false;
    constexpr int kParts = kOutputs / kLanes;
    Lanes sums[kParts][kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      Lanes total[kParts] = {};
      for (uint32_t s = first_slot_[i + lane]; s < first_slot_[i + lane + 1]; ++s) {
        const float* from = &slot_sums_[static_cast<size_t>(slots_of_[s]) * kOutputs];
        for (int part = 0; part < kParts; ++part) total[part] += load(from + part * kLanes);
      }
      for (int part = 0; part < kParts; ++part) sums[part][lane] = total[part];
    }
    alignas(64) float columns[kOutputs][kLanes];
    for (int part = 0; part < kParts; ++part)
      transpose(sums[part], columns[part * kLanes], kLanes);
    m.g = load(columns[kG]);
    m.gx = load(columns[kGx]);
    m.gy = load(columns[kGy]);
    m.gxx = load(columns[kGxx]);
    m.gxy = load(columns[kGxy]);
    m.gyy = load(columns[kGyy]);
    for (int k = 0; k < 3; ++k) m.color[k] = load(columns[kSumRed + 2 * k]);
    m.depth = load(columns[kSumDepth]);
    m.depth_x = load(columns[kSumDepthX]);
    m.depth_y = load(columns[kSumDepthY]);
    m.weight = load(columns[kSumWeight]);
    return true;
  }

  void gather_group(const Parameters& in, const View& view, int i, const GradientArrays& out,
                    double* pose) {
    Moments m;
    ParameterGradients d;
    if (sum_slots(i, m)) {
      Ellipses e;
      transform_means(in, i, view, e);
      project(in, i, view, e);
      project_backward(e, view, m, d);
      // a Gaussian without slots may lie behind the camera: its lane holds rubbish
      Mask seen = {};
      for (int lane = 0; lane < kLanes; ++lane)
        seen[lane] = first_slot_[i + lane] < first_slot_[i + lane + 1] ? -1 : 0;
      Lanes* all = reinterpret_cast<Lanes*>(&d);
      for (size_t k = 0; k < sizeof(d) / sizeof(Lanes); ++k) all[k] = seen ? all[k] : Lanes{};
      for (int k = 0; k < 6; ++k) pose[k] += sum(d.pose[k]);
    } else {
      m = Moments{};
      d = ParameterGradients{};
    }
    store_rows<3>(out.means, i, in.count, d.mean);
    store_rows<4>(out.quats, i, in.count, d.quat);
    store_rows<3>(out.log_scales, i, in.count, d.log_scale);
    store_rows<1>(out.logit_opacities, i, in.count, &d.logit_opacity);
    store_rows<3>(out.colors, i, in.count, m.color);
    store_rows<1>(out.visibility, i, in.count, &m.weight);
  }

  void gather_statistics(int count, const Statistics& stats, int threads) {
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int i = 0; i < count; ++i) {
      float total = 0, best = 0;
      for (uint32_t s = first_slot_[i]; s < first_slot_[i + 1]; ++s) {
        const float* slot = &slot_sums_[static_cast<size_t>(slots_of_[s]) * kOutputs];
        total += slot[0];
        best = std::max(best, slot[1]);
      }
      stats.visibility[i] = total;
      stats.max_weight[i] = best;
    }
  }

  Layout layout_;
  int tiles_x_ = 0, tiles_y_ = 0;
  size_t visible_ = 0, slots_ = 0;
  Buffer<float> planes_, slot_sums_;
  Buffer<double> pose_sums_;
  Buffer<Record> records_;
  Buffer<Box> boxes_;
  Buffer<uint32_t> keys_, tile_first_, tile_next_, slot_gaussian_;
  Buffer<uint32_t> first_slot_, slot_next_, slots_of_;  // see number_slots
  Buffer<Entry> entries_, spare_;
  Buffer<Kept> kept_;
  std::vector<uint32_t> low_, high_;
  std::vector<Arena> arenas_;
  std::vector<TileScratch> scratch_;
  Loss loss_;
};

// ---- Python ------------------------------------------------------------------------------------

// rasterize.py checks shapes; these only insist on float32 in rows.
using Floats = py::array_t<float, py::array::c_style>;
using Bytes = py::array_t<uint8_t, py::array::c_style>;

Parameters parameters_of(const py::tuple& gaussians, const py::object& active) {
  Parameters p{};
  const float** fields[] = {&p.means,           &p.quats,  &p.log_scales,
                            &p.logit_opacities, &p.colors, &p.p_dynamic};
  if (gaussians.size() != 6) throw std::invalid_argument("gaussians: expected six arrays");
  for (int k = 0; k < 6; ++k) *fields[k] = gaussians[k].cast<Floats>().data();
  p.count = static_cast<int>(gaussians[5].cast<Floats>().size());
  p.active = active.is_none() ? nullptr : active.cast<Bytes>().data();
  return p;
}

// `pose` is T_camera_world, row-major; `intrinsics` are fx fy cx cy.
View view_of(int width, int height, const std::array<double, 4>& intrinsics,
             const std::array<double, 16>& pose) {
  View v{};
  v.width = width;
  v.height = height;
  v.fx = static_cast<float>(intrinsics[0]);
  v.fy = static_cast<float>(intrinsics[1]);
  v.cx = static_cast<float>(intrinsics[2]);
  v.cy = static_cast<float>(intrinsics[3]);
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) v.rotation[3 * r + c] = static_cast<float>(pose[4 * r + c]);
    v.translation[r] = static_cast<float>(pose[4 * r + 3]);
  }
  v.set_limits();
  return v;
}

// Planes that travel to Python: colour [H, W, 3], depth, silhouette, p_dynamic [H, W].
void copy_rendered(Rasterizer& r, const py::tuple& images, int threads) {
  const Layout layout = r.layout();
  float* color = images[0].cast<Floats>().mutable_data();
  float* others[3];
  for (int k = 0; k < 3; ++k) others[k] = images[1 + k].cast<Floats>().mutable_data();
  py::gil_scoped_release release;
#pragma omp parallel for schedule(static) num_threads(threads)
  for (int y = 0; y < layout.height; ++y) {
    const float *red = r.plane(kRed) + layout.at(y, 0), *green = r.plane(kGreen) + layout.at(y, 0),
                *blue = r.plane(kBlue) + layout.at(y, 0);
    float* row = color + static_cast<size_t>(y) * layout.width * 3;
    for (int x = 0; x < layout.width; x += kLanes) {
      const Lanes columns[3] = {load(red + x), load(green + x), load(blue + x)};
      store_rows<3>(row, x, layout.width, columns);
    }
    for (int k = 0; k < 3; ++k)
      std::memcpy(others[k] + static_cast<size_t>(y) * layout.width,
                  r.plane(kDepth + k) + layout.at(y, 0), layout.width * sizeof(float));
  }
}

void render(Rasterizer& r, const py::tuple& gaussians, const py::object& active, int width,
            int height, const std::array<double, 4>& intrinsics,
            const std::array<double, 16>& pose, int threads, const py::tuple& images,
            const py::object& statistics) {
  const Parameters in = parameters_of(gaussians, active);
  const View view = view_of(width, height, intrinsics, pose);
  Statistics stats{};
  if (!statistics.is_none()) {
    const py::tuple arrays = statistics;
    stats.visibility = arrays[0].cast<Floats>().mutable_data();
    stats.max_weight = arrays[1].cast<Floats>().mutable_data();
    stats.radius = arrays[2].cast<Floats>().mutable_data();
  }
  {
    py::gil_scoped_release release;
    r.render(in, view, threads, stats);
  }
  copy_rendered(r, images, threads);
}

GradientArrays gradients_of(const py::tuple& arrays, py::array_t<double>& pose) {
  GradientArrays out{};
  float** fields[] = {&out.means,           &out.quats,  &out.log_scales,
                      &out.logit_opacities, &out.colors, &out.visibility};
  for (int k = 0; k < 6; ++k) *fields[k] = arrays[k].cast<Floats>().mutable_data();
  out.pose = pose.mutable_data();
  return out;
}

py::array_t<double> backward(Rasterizer& r, const py::tuple& gaussians, const py::object& active,
                             int width, int height, const std::array<double, 4>& intrinsics,
                             const std::array<double, 16>& pose, int threads, const Floats& d_color,
                             const Floats& d_depth, const Floats& d_silhouette,
                             const py::tuple& gradients) {
  const Parameters in = parameters_of(gaussians, active);
  const View view = view_of(width, height, intrinsics, pose);
  py::array_t<double> d_pose(6);
  const GradientArrays out = gradients_of(gradients, d_pose);
  const float *color = d_color.data(), *depth = d_depth.data(), *silhouette = d_silhouette.data();
  py::gil_scoped_release release;
  r.render(in, view, threads, Statistics{});
  const Layout layout = r.layout();
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const size_t from = static_cast<size_t>(y) * width + x, to = layout.at(y, x);
      for (int c = 0; c < 3; ++c) r.plane(kGradRed + c)[to] = color[3 * from + c];
      r.plane(kGradDepth)[to] = depth[from];
      r.plane(kGradSilhouette)[to] = silhouette[from];
    }
  r.backward(in, view, threads, out);
  return d_pose;
}

py::tuple fused_step(Rasterizer& r, const py::tuple& gaussians, const py::object& active, int width,
                     int height, const std::array<double, 4>& intrinsics,
                     const std::array<double, 16>& pose, int threads, const Floats& target_color,
                     const Floats& target_depth, const Floats& pixel_weight,
                     const std::array<float, 5>& weights, const std::array<float, 2>& exposure,
                     const py::tuple& gradients, const py::object& images) {
  const Parameters in = parameters_of(gaussians, active);
  const View view = view_of(width, height, intrinsics, pose);
  py::array_t<double> d_pose(6);
  const GradientArrays out = gradients_of(gradients, d_pose);
  const LossInput loss_in{target_color.data(), target_depth.data(), pixel_weight.data(),
                          weights[0],          weights[1],          weights[2],
                          weights[3],          weights[4],          exposure[0],
                          exposure[1]};
  LossResult loss;
  {
    py::gil_scoped_release release;
    r.render(in, view, threads, Statistics{});
    loss = r.loss(loss_in, threads);
    r.backward(in, view, threads, out);
  }
  if (!images.is_none()) copy_rendered(r, images, threads);
  return py::make_tuple(loss.total, loss.l1, loss.ssim, loss.depth, loss.smooth, loss.empty,
                        loss.d_log_gain, loss.d_offset, d_pose);
}

// Whether this processor (and its kernel) can run the build `name`.
bool supports(const std::string& name) {
#if defined(__x86_64__) || defined(__i386__)
  __builtin_cpu_init();
  if (name == "avx512")
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw");
  if (name == "avx2") return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
  return name == "base";
}

}  // namespace bdgs

PYBIND11_MODULE(BDGS_MODULE, m) {
  using namespace bdgs;
  m.doc() = "Gaussian rasteriser; use bdgs_ros.mapping.rasterize, which checks its arguments";
  m.def("supports", &supports);
  m.def("adam_steps", &adam_steps);
  py::class_<Rasterizer>(m, "Rasterizer", py::module_local())
      .def(py::init<>())
      .def("render", &render)
      .def("backward", &backward)
      .def("fused_step", &fused_step)
      .def_property_readonly("slots", &Rasterizer::slots)
      .def_property_readonly("kept_pairs", &Rasterizer::kept_pairs);
}
