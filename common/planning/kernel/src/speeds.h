/* The fastest speeds along a path from rest to rest: the two passes of common/planning/retiming.py. */
#ifndef ZK_SPEEDS_H
#define ZK_SPEEDS_H

#include <math.h>

/* count intervals of `rows` limits: -down - slope x <= u <= up - slope x. highest (count + 1): limit of x at the grid
   points, lowered in place; x (count + 1), u (count). Returns -1, or a grid point i that cannot be passed: i backwards,
   count + i forwards. */
static int speeds(int count, int rows, const double *lengths, const double *up, const double *down, const double *slope,
                  double *highest, double *x, double *u) {
    for (int i = count - 1; i >= 0; i--) {
        const double *a = down + (long)rows * i, *b = slope + (long)rows * i;
        double most = highest[i], twice = 2 * lengths[i];
        for (int k = 0; k < rows; k++) {
            double rest = 1 - twice * b[k];
            if (!(rest > 1e-12) || isinf(a[k])) continue;
            most = fmin(most, (highest[i + 1] + twice * a[k]) / rest);
        }
        if (!(most >= 0)) return i;
        highest[i] = most;
    }
    x[0] = 0;
    for (int i = 0; i < count; i++) {
        const double *a = up + (long)rows * i, *b = slope + (long)rows * i;
        double least = INFINITY;
        for (int k = 0; k < rows; k++) least = fmin(least, a[k] - b[k] * x[i]);
        double next = fmin(highest[i + 1], x[i] + 2 * lengths[i] * least);
        if (!(next >= 0) || (next <= 0 && x[i] <= 0)) return count + i;
        u[i] = (next - x[i]) / (2 * lengths[i]);
        x[i + 1] = next;
    }
    return -1;
}

#endif
