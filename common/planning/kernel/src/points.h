/* Obstacles from cameras: spheres, each about some measured points, in a tree of bounding spheres.

   A query descends only where a node's sphere does not decide, so distant spheres cost nothing, and the answer is the
   same as for all spheres one by one. */
#ifndef ZK_POINTS_H
#define ZK_POINTS_H

#include <stdint.h>

#include "gjk.h"

typedef struct {
    double c[3], r; /* [m], world: about all spheres below */
    int right;      /* the second child; the first one follows its parent. 0: a leaf, one of the spheres */
} sphere_node;

struct points {
    int count, nodes; /* spheres of the set; all of the tree, the root first */
    sphere_node *node;
};

/* A node to check, and the direction to its parent. */
typedef struct {
    int node;
    double n[3];
} visit;

#define DEEPEST 80 /* limit of nodes on the stack: one for each level; 2^31 spheres have 31 levels */

/* Puts the k-th point along an axis in its place: Hoare's quickselect. */
static void choose_middle(double (*p)[4], int count, int k, int axis) {
    int low = 0, high = count - 1;
    while (low < high) {
        double pivot = p[low + (high - low) / 2][axis];
        int i = low, j = high;
        while (i <= j) {
            while (p[i][axis] < pivot) i++;
            while (p[j][axis] > pivot) j--;
            if (i > j) break;
            double swap[4];
            memcpy(swap, p[i], sizeof swap), memcpy(p[i], p[j], sizeof swap), memcpy(p[j], swap, sizeof swap);
            i++, j--;
        }
        if (k <= j)
            high = j;
        else if (k >= i)
            low = i;
        else
            return;
    }
}

static void build_nodes(sphere_node *node, int at, double (*p)[4], int count) {
    sphere_node *b = &node[at];
    if (count == 1) {
        memcpy(b->c, p[0], sizeof b->c);
        b->r = p[0][3], b->right = 0;
        return;
    }
    double low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY};
    for (int i = 0; i < count; i++)
        for (int k = 0; k < 3; k++) {
            if (p[i][k] - p[i][3] < low[k]) low[k] = p[i][k] - p[i][3];
            if (p[i][k] + p[i][3] > high[k]) high[k] = p[i][k] + p[i][3];
        }
    int axis = 0;
    for (int k = 0; k < 3; k++) {
        b->c[k] = 0.5 * (low[k] + high[k]);
        if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
    }
    double most = 0;
    for (int i = 0; i < count; i++) {
        double d[3];
        sub3(p[i], b->c, d);
        double far = norm3(d) + p[i][3];
        if (far > most) most = far;
    }
    b->r = most * (1 + 1e-12) + 1e-12;
    int half = count / 2;
    choose_middle(p, count, half, axis);
    b->right = at + 2 * half;
    build_nodes(node, at + 1, p, half);
    build_nodes(node, b->right, p + half, count - half);
}

static void points_free(struct points *set) {
    if (set) free(set->node);
    free(set);
}

/* A set of spheres (count, 4): centre and radius. NULL if out of memory. */
static struct points *points_of(int count, const double *spheres) {
    struct points *set = calloc(1, sizeof *set);
    double(*copy)[4] = malloc(sizeof(double) * 4 * ((size_t)count + 1));
    sphere_node *node = malloc(sizeof(sphere_node) * (2 * (size_t)count + 1));
    if (!set || !copy || !node) {
        free(set), free(copy), free(node);
        return NULL;
    }
    memcpy(copy, spheres, sizeof(double) * 4 * (size_t)count);
    if (count) build_nodes(node, 0, copy, count);
    free(copy);
    *set = (struct points){count, count ? 2 * count - 1 : 0, node};
    return set;
}

/* Lower bound [m] of the distance of a sphere and a node. */
static inline double node_apart(const double *a, double ra, const sphere_node *b) {
    double d[3];
    sub3(b->c, a, d);
    return norm3(d) - ra - b->r;
}

/* Bounds on the distance of a shape at a pose (world) from a node's sphere, as in gjk; directions in world. */
static inline void node_distance(const shape *A, const pose *T, const sphere_node *b, const double *begin, double enough,
                                 double near, double share, gjk_answer *out) {
    shape B = {0};
    pose to = *T;
    B.kind = SPHERE, B.radius = b->r;
    sub3(T->p, b->c, to.p);
    gjk(A, &B, &to, begin, enough, near, share, out);
}

/* Pushes the children of a node whose spheres are at most `far` from a sphere, the nearer one on top. */
static inline int push_children(const sphere_node *node, const visit *v, const double *middle, double sphere, double far,
                                visit *stack, int top) {
    int one = v->node + 1, other = node[v->node].right;
    double d1 = node_apart(middle, sphere, &node[one]), d2 = node_apart(middle, sphere, &node[other]);
    if (d1 < d2) {
        int swap = one;
        double way = d1;
        one = other, other = swap, d1 = d2, d2 = way;
    }
    if (!(d1 > far)) stack[top] = *v, stack[top++].node = one;
    if (!(d2 > far)) stack[top] = *v, stack[top++].node = other;
    return top;
}

/* -1 if all spheres of the set are farther than `far` from a sphere, or farther than `need` from the shape A in it, which
   may be NULL; else the node of a sphere that is not. axis: direction to start with, and the last successful one. */
static int points_touch(const struct points *set, const shape *A, const pose *T, const double *middle, double sphere,
                        double far, double need, double *axis, long long *searches) {
    if (!set || !set->count || node_apart(middle, sphere, &set->node[0]) > far) return -1;
    visit stack[DEEPEST] = {{0, {axis[0], axis[1], axis[2]}}};
    int top = 1;
    while (top) {
        visit v = stack[--top];
        const sphere_node *b = &set->node[v.node];
        if (A && (!b->right || b->r < A->sphere)) {
            gjk_answer found;
            node_distance(A, T, b, v.n, need, need, 1.0, &found);
            ++*searches;
            if (found.below > -1e9) memcpy(v.n, found.n, sizeof v.n), memcpy(axis, found.n, sizeof v.n);
            if (found.below > need) continue;
        }
        if (!b->right) return v.node;
        top = push_children(set->node, &v, middle, sphere, far, stack, top);
    }
    return -1;
}

/* Bounds on the distance of a shape from the nearest sphere of a set. */
static void points_distance(const struct points *set, const shape *A, const pose *T, const double *middle, double *axis,
                            double *above, double *below) {
    *above = *below = INFINITY;
    if (!set || !set->count) return;
    visit stack[DEEPEST] = {{0, {axis[0], axis[1], axis[2]}}};
    int top = 1;
    while (top) {
        visit v = stack[--top];
        const sphere_node *b = &set->node[v.node];
        if (node_apart(middle, A->sphere, b) > *above) continue;
        if (!b->right || b->r < A->sphere) {
            gjk_answer found;
            int leaf = !b->right;
            node_distance(A, T, b, v.n, leaf ? INFINITY : *above, leaf ? -INFINITY : *above, 1.0, &found);
            if (found.below > -1e9) memcpy(v.n, found.n, sizeof v.n);
            if (leaf) {
                if (found.above < *above) *above = found.above, memcpy(axis, v.n, sizeof v.n);
                if (found.below < *below) *below = found.below;
                continue;
            }
            if (found.below > *above) continue;
        }
        top = push_children(set->node, &v, middle, A->sphere, *above, stack, top);
    }
}

/* Spheres about points (count, 3), world: one for each cube of a grid that contains any, centred at their mean, about all
   of them and at least half a side large. `out` has room for `count`. Ignores points that are not finite or farther than
   1e4 m, and those with a 1 in `skip` (may be NULL). Returns the number of spheres, or -1 if out of memory. */
static int downsample_points(int count, const double *p, const uint8_t *skip, double side, double (*out)[4]) {
    int bits = 4, used = 0;
    while ((1 << bits) < 2 * (long long)count && bits < 30) bits++;
    size_t room = (size_t)1 << bits;
    int *slot = malloc(sizeof(int) * room), *owner = malloc(sizeof(int) * ((size_t)count + 1));
    int64_t *cell = malloc(sizeof(int64_t) * ((size_t)count + 1));
    int *members = malloc(sizeof(int) * ((size_t)count + 1));
    if (!slot || !owner || !cell || !members) {
        free(slot), free(owner), free(cell), free(members);
        return -1;
    }
    memset(slot, 255, sizeof(int) * room);
    double scale = 1 / side;
    for (int i = 0; i < count; i++) {
        const double *at = p + 3 * (size_t)i;
        owner[i] = -1;
        if ((skip && skip[i]) || !(fabs(at[0]) < 1e4 && fabs(at[1]) < 1e4 && fabs(at[2]) < 1e4)) continue;
        int64_t key = 0;
        for (int k = 0; k < 3; k++) {
            double where = floor(at[k] * scale);
            where = where < -1048576.0 ? -1048576.0 : where > 1048575.0 ? 1048575.0 : where;
            key = key << 21 | ((int64_t)where + 1048576);
        }
        uint64_t h = ((uint64_t)key * 0x9e3779b97f4a7c15u) >> (64 - bits);
        while (slot[h] >= 0 && cell[slot[h]] != key) h = (h + 1) & (room - 1);
        int v = slot[h];
        if (v < 0) {
            v = slot[h] = used++;
            cell[v] = key, members[v] = 0;
            memset(out[v], 0, sizeof out[v]);
        }
        for (int k = 0; k < 3; k++) out[v][k] += at[k];
        owner[i] = v, members[v]++;
    }
    for (int v = 0; v < used; v++)
        for (int k = 0; k < 3; k++) out[v][k] /= members[v];
    for (int i = 0; i < count; i++) {
        if (owner[i] < 0) continue;
        double *b = out[owner[i]], d[3];
        sub3(p + 3 * (size_t)i, b, d);
        double square = dot3(d, d);
        if (square > b[3]) b[3] = square;
    }
    for (int v = 0; v < used; v++) out[v][3] = fmax(sqrt(out[v][3]) * (1 + 1e-12) + 1e-12, 0.5 * side);
    free(slot), free(owner), free(cell), free(members);
    return used;
}

#endif
