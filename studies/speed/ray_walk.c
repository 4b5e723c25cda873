/* The ray kernel of gnd.vehicle_agent.detect.kernel in C, word for word: what a compiler makes of the same walk.
   Compiled on the spot by studies/speed/yardstick.py; the counts must be equal to the bit. */
#include <math.h>
#include <stdint.h>

typedef struct {
    int64_t rule;
    double r2_block, r2_pass, r2_plane, r2_face, ahead_m, beyond_m, face_m, range_min_m, range_max_m;
    double pose_m2, pose_rad2, included_m2, block_gain, beyond_gain;
} Parameters;

enum { WORDS = 16, BI = 12, BO = 13, PI = 14, PO = 15 };
static const int32_t UNKNOWN = INT32_MIN;

static inline double r2_of(const float *W, double x, double y, double z) {
    double a = W[0] * x, b = W[1] * x + W[2] * y, c = W[3] * x + W[4] * y + W[5] * z;
    return a * a + b * b + c * c;
}

static inline int passes(const float *r, const double *o, const double *v, double t_in, double t_out, double length,
                         double beyond_m, const Parameters *p) {
    double dx = r[6] - o[0], dy = r[7] - o[1], dz = r[8] - o[2];
    double nx = r[9], ny = r[10], nz = r[11];
    if (p->rule == 2 && nx * nx + ny * ny + nz * nz > 0.5) {
        double along = nx * v[0] + ny * v[1] + nz * v[2];
        double t = (nx * dx + ny * dy + nz * dz) / along;
        if (!(t_in <= t && t <= t_out) || (1.0 - t) * fabs(along) <= beyond_m) return 0;
        return r2_of(r, t * v[0] - dx, t * v[1] - dy, t * v[2] - dz) <= p->r2_plane;
    }
    double yx = r[0] * v[0], yy = r[1] * v[0] + r[2] * v[1], yz = r[3] * v[0] + r[4] * v[1] + r[5] * v[2];
    double zx = r[0] * dx, zy = r[1] * dx + r[2] * dy, zz = r[3] * dx + r[4] * dy + r[5] * dz;
    double t = (yx * zx + yy * zy + yz * zz) / (yx * yx + yy * yy + yz * yz);
    t = t < t_in ? t_in : t;
    t = t > t_out ? t_out : t;
    if (p->rule != 0 && (1.0 - t) * length < p->ahead_m) return 0;
    return r2_of(r, t * v[0] - dx, t * v[1] - dy, t * v[2] - dz) <= p->r2_pass;
}

static inline double r2_block(const float *block, const float *records, int64_t row, const double *at) {
    const float *r = records + row * WORDS;
    return r2_of(block + row * 6, at[0] - r[6], at[1] - r[7], at[2] - r[8]);
}

static inline int explains(const int32_t *state, int64_t at, double f, int64_t i, int64_t n, int64_t stride, double face,
                           const float *block, const float *records, const double *point, const Parameters *p) {
    int64_t row = -1;
    if (f < face && i > 0) row = state[at - stride];
    else if (f > 1.0 - face && i < n - 1) row = state[at + stride];
    return row >= 0 && r2_block(block, records, row, point) <= p->r2_face;
}

static inline void clip(double g, double d, double n, double *t0, double *t1) {
    if (d == 0.0) {
        if (!(0.0 <= g && g < n)) { *t0 = INFINITY; *t1 = -INFINITY; }
        return;
    }
    double a = -g / d, b = (n - g) / d, low = a < b ? a : b, high = a < b ? b : a;
    if (low > *t0) *t0 = low;
    if (high < *t1) *t1 = high;
}

static inline int64_t index_of(double g, int64_t n) {
    int64_t i = (int64_t)floor(g);
    return i < 0 ? 0 : i > n - 1 ? n - 1 : i;
}

int64_t cast_rays(int64_t n_points, const double *points, int64_t n_origins, const double *origins,
                  const double *anchor_m, const double *A, const double *b, int32_t *state, const int64_t *shape,
                  int32_t *words, const float *block, const Parameters *p, const uint8_t *moving,
                  uint8_t *kept) {
    const float *records = (const float *)words;
    const int64_t strides[3] = {shape[1] * shape[2], shape[2], 1};
    double face[3];
    for (int a = 0; a < 3; a++)
        face[a] = p->face_m * sqrt(A[3 * a] * A[3 * a] + A[3 * a + 1] * A[3 * a + 1] + A[3 * a + 2] * A[3 * a + 2]);
    int64_t cast = 0;
    for (int64_t ray = 0; ray < n_points; ray++) {
        kept[ray] = 0;
        const double *from = origins + (n_origins == 1 ? 0 : 3 * ray), *to = points + 3 * ray;
        const double o[3] = {from[0] - anchor_m[0], from[1] - anchor_m[1], from[2] - anchor_m[2]};
        const double end[3] = {to[0] - anchor_m[0], to[1] - anchor_m[1], to[2] - anchor_m[2]};
        const double v[3] = {end[0] - o[0], end[1] - o[1], end[2] - o[2]};
        double length = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
        if (!(length > p->range_min_m)) continue;
        double s2 = p->pose_m2 + p->pose_rad2 * length * length - p->included_m2;
        if (s2 < 0.0) s2 = 0.0;
        double beyond_m = sqrt(p->beyond_m * p->beyond_m + p->beyond_gain * s2);
        double g[3], d[3], t[3], dt[3], reach = p->range_max_m / length, t_in = 0.0, t_end = reach < 1.0 ? reach : 1.0;
        for (int a = 0; a < 3; a++) {
            g[a] = A[3 * a] * o[0] + A[3 * a + 1] * o[1] + A[3 * a + 2] * o[2] + b[a];
            d[a] = A[3 * a] * v[0] + A[3 * a + 1] * v[1] + A[3 * a + 2] * v[2];
            clip(g[a], d[a], (double)shape[a], &t_in, &t_end);
        }
        if (t_in >= t_end) continue;
        cast++;
        int64_t last[3], left[3], step[3], at = 0, crossed = 0;
        for (int a = 0; a < 3; a++) {
            int64_t i = index_of(g[a] + t_in * d[a], shape[a]);
            last[a] = index_of(g[a] + t_end * d[a], shape[a]);
            left[a] = last[a] > i ? last[a] - i : i - last[a];
            step[a] = last[a] > i ? strides[a] : -strides[a];
            at += i * strides[a];
            crossed += left[a];
            t[a] = left[a] ? ((d[a] > 0.0 ? i + 1.0 : (double)i) - g[a]) / d[a] : INFINITY;
            dt[a] = 1.0 / fabs(d[a]);
        }
        for (; crossed > 0; crossed--) {
            int64_t row = state[at];
            int a = t[0] <= t[1] && t[0] <= t[2] ? 0 : t[1] <= t[2] ? 1 : 2;
            double t_out = t[a];
            if (row >= 0) words[row * WORDS + (passes(records + row * WORDS, o, v, t_in, t_out, length, beyond_m, p) ? PI : PO)]++;
            else if (row != UNKNOWN) state[at] = (int32_t)(row - 1);
            t_in = t_out;
            at += step[a];
            t[a] = --left[a] > 0 ? t[a] + dt[a] : INFINITY;
        }
        int64_t row = state[at];
        if (t_end < 1.0 || row == UNKNOWN || moving[ray]) continue;
        if (row >= 0 && r2_block(block, records, row, end) <= p->r2_block * (1.0 + p->block_gain * s2)) {
            words[row * WORDS + BI]++;
            kept[ray] = 1;
            continue;
        }
        int is_explained = 0;
        for (int a = 0; a < 3 && !is_explained; a++)
            is_explained = explains(state, at, g[a] + d[a] - last[a], last[a], shape[a], strides[a], face[a], block,
                                    records, end, p);
        if (is_explained) continue;
        kept[ray] = 1;
        if (row >= 0) words[row * WORDS + BO]++;
    }
    return cast;
}
