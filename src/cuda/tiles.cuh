// Which Gaussians touch which tile, near to far.
//
// Gaussians are sorted by depth once; in that order each writes one pair (tile, slot) for every tile
// that its box touches, and a stable sort by tile, of a few bits, keeps them near to far within it.
// A Gaussian's own slots lie next to each other, so what the pixels of its tiles find out about it
// is written to its slots and added up in their order, without atomic additions: results repeat to
// the last bit.

#pragma once

#include "project.cuh"

namespace bdgs {

constexpr int kTile = 16, kTilePixels = kTile * kTile;
constexpr uint32_t kDepthBits = 24, kCulled = 1u << kDepthBits;
constexpr int kPerBlock = 128;  // threads, where each has a Gaussian or a slot of its own

struct alignas(8) Box {  // pixels, inclusive
  uint16_t x0, x1, y0, y1;

  __device__ int tiles() const {
    return (x1 / kTile - x0 / kTile + 1) * (y1 / kTile - y0 / kTile + 1);
  }
};

// alpha = exp2(l + a dx^2 + b dx dy + c dy^2), and what is blended with it.
struct alignas(16) Record {
  float u, v, a, b, c, l, red, green, blue, z, zeta_u, zeta_v, p_dynamic;
  uint32_t box_x, box_y;  // as in Box: 16 bits each
  float unused;
};
static_assert(sizeof(Record) == 4 * sizeof(float4), "loaded by four threads");

struct Projected {  // [N]
  Record* records;
  uint32_t *keys, *ids, *tiles;
};

__device__ inline void cull(const Projected& out, int i, float* radius) {
  out.keys[i] = kCulled;
  out.tiles[i] = 0;
  if (radius != nullptr) radius[i] = 0.0f;
}

__global__ void project_kernel(Gaussians in, Camera camera, const double* T, Projected out,
                               float* radius) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= in.count) return;
  out.ids[i] = i;
  const Pose pose(T);
  const bool drawn = (in.active == nullptr || in.active[i]) &&
                     in.logit_opacities[i] > in.min_logit && camera_z(in, i, pose) > kNear;
  if (!drawn) return cull(out, i, radius);
  const Ellipse e = project(in, i, pose, camera);
  const float l = log2f(fmaxf(e.opacity, 1e-30f));
  const float reach = fmaxf((2.0f * kLn2) * (l - log2f(kMinAlpha)), 0.0f);
  const float half_x = sqrtf(e.s00 * reach), half_y = sqrtf(e.s11 * reach);
  const float* color = in.colors + 3 * static_cast<size_t>(i);
  const float* s = in.log_scales + 3 * static_cast<size_t>(i);
  const float blended = color[0] + color[1] + color[2] + in.p_dynamic[i];
  // comparisons that a NaN fails: one would fill the tile
  const bool visible = reach > 0.0f && e.u + half_x >= 0.0f &&
                       e.u - half_x <= camera.width - 1.0f && e.v + half_y >= 0.0f &&
                       e.v - half_y <= camera.height - 1.0f && e.inverse_det > 0.0f &&
                       half_x < 1e6f && half_y < 1e6f && fabsf(blended) < 1e30f &&
                       fabsf(s[0] + s[1] + s[2]) < 1e30f;
  if (!visible) return cull(out, i, radius);
  // ceil of the lower and floor of the upper bound, widened a little against rounding
  const float slack = 1e-3f;
  const int x0 = static_cast<int>(fmaxf(e.u - half_x - slack + 1.0f, 0.0f));
  const int y0 = static_cast<int>(fmaxf(e.v - half_y - slack + 1.0f, 0.0f));
  const float right = fminf(e.u + half_x + slack, camera.width - 1.0f);
  const float bottom = fminf(e.v + half_y + slack, camera.height - 1.0f);
  const int x1 = static_cast<int>(right), y1 = static_cast<int>(bottom);
  if (right < 0.0f || bottom < 0.0f || x0 > x1 || y0 > y1) return cull(out, i, radius);

  const Box box{static_cast<uint16_t>(x0), static_cast<uint16_t>(x1), static_cast<uint16_t>(y0),
                static_cast<uint16_t>(y1)};
  // positive floats sort like their bits; eight units of the last place are 1e-6 relative
  const uint32_t key = (__float_as_uint(e.z) - __float_as_uint(kNear)) >> 3;
  out.keys[i] = key < kCulled - 1 ? key : kCulled - 1;
  out.tiles[i] = box.tiles();
  if (radius != nullptr) radius[i] = fmaxf(half_x, half_y);
  const float scale = (-0.5f * kLog2E) * e.inverse_det;
  Record r;
  r.u = e.u;
  r.v = e.v;
  r.a = scale * e.s11;
  r.b = -2.0f * scale * e.s01;
  r.c = scale * e.s00;
  r.l = l;
  r.red = color[0];
  r.green = color[1];
  r.blue = color[2];
  r.z = e.z;
  r.zeta_u = e.zeta_u;
  r.zeta_v = e.zeta_v;
  r.p_dynamic = in.p_dynamic[i];
  r.box_x = box.x0 | static_cast<uint32_t>(box.x1) << 16;
  r.box_y = box.y0 | static_cast<uint32_t>(box.y1) << 16;
  r.unused = 0.0f;
  out.records[i] = r;
}

__device__ inline Box box_of(const Record& r) {
  return {static_cast<uint16_t>(r.box_x & 0xffff), static_cast<uint16_t>(r.box_x >> 16),
          static_cast<uint16_t>(r.box_y & 0xffff), static_cast<uint16_t>(r.box_y >> 16)};
}

// How many slots the Gaussians take in the order of depth; the last place is for the total.
__global__ void order_kernel(int count, const uint32_t* sorted, const uint32_t* tiles,
                             uint32_t* out) {
  const int k = blockIdx.x * blockDim.x + threadIdx.x;
  if (k <= count) out[k] = k < count ? tiles[sorted[k]] : 0;
}

// Slots of the Gaussians: where those of each begin, and the tile and Gaussian of each.
__global__ void emit_kernel(int count, int tiles_x, const uint32_t* sorted, const uint32_t* firsts,
                            const uint32_t* tiles, const Record* records, uint32_t* first_of,
                            uint32_t* slot_tile, uint32_t* slot_number, uint32_t* slot_gaussian) {
  const int k = blockIdx.x * blockDim.x + threadIdx.x;
  if (k >= count) return;
  const uint32_t id = sorted[k];
  uint32_t slot = firsts[k];
  first_of[id] = slot;
  if (tiles[id] == 0) return;
  const Box box = box_of(records[id]);
  for (int ty = box.y0 / kTile; ty <= box.y1 / kTile; ++ty)
    for (int tx = box.x0 / kTile; tx <= box.x1 / kTile; ++tx, ++slot) {
      slot_tile[slot] = ty * tiles_x + tx;
      slot_number[slot] = slot;
      slot_gaussian[slot] = id;
    }
}

struct Range {
  uint32_t begin, end;
};

// `ranges` were zeros: a tile without slots keeps them.
__global__ void range_kernel(uint32_t count, const uint32_t* sorted_tile, Range* ranges) {
  const uint32_t s = blockIdx.x * blockDim.x + threadIdx.x;
  if (s >= count) return;
  const uint32_t tile = sorted_tile[s];
  if (s == 0 || sorted_tile[s - 1] != tile) ranges[tile].begin = s;
  if (s == count - 1 || sorted_tile[s + 1] != tile) ranges[tile].end = s + 1;
}

struct Tiles {
  const Record* records;
  const Range* ranges;
  const uint32_t *slots, *slot_gaussian;  // slots by tile; the Gaussian of a slot
  int tiles_x;
};

}  // namespace bdgs
