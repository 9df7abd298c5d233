/* What a custom call (jax.ffi) could gain at most on the gradient of a net: forward and reverse of one step of its springs,
   as plain C over shifted slices, (3, particle) float32, one thread, nothing around it.

       gcc -O3 -march=native -ffast-math benchmarks/custom_call.c -o custom_call -lm && ./custom_call

   64x64 particles, springs along rows, columns and both diagonals: 15,876. Least of 2,000 rounds. */
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

#define N 64
#define P (N * N)
static const float KS = 1000, KD = 0.1f, LENGTH = 1;
static const int SHIFTS[4][2] = {{1, 0}, {0, 1}, {1, 1}, {1, -1}};
static float x[3][P], v[3][P], force[3][P], of_x[3][P], of_v[3][P], of_force[3][P];

#define SPRING                                                                                                      \
    float d[3], w[3], u[3], length2 = 0, speed = 0;                                                                 \
    for (int k = 0; k < 3; k++) { d[k] = x[k][b] - x[k][a]; w[k] = v[k][b] - v[k][a]; length2 += d[k] * d[k]; }      \
    float length = sqrtf(length2), inverse = 1 / length;                                                            \
    for (int k = 0; k < 3; k++) { u[k] = d[k] * inverse; speed += w[k] * u[k]; }                                     \
    float size = KS * (length - LENGTH) + KD * speed;

static void forward(int rows, int columns) {
    int first = columns < 0, last = columns > 0 ? N - 1 : N;
    for (int i = 0; i < N - rows; i++)
#pragma GCC ivdep
        for (int a = i * N + first; a < i * N + last; a++) {
            int b = a + rows * N + columns;
            SPRING
            for (int k = 0; k < 3; k++) { force[k][a] += size * u[k]; force[k][b] -= size * u[k]; }
        }
}

static float reverse(int rows, int columns) {
    int first = columns < 0, last = columns > 0 ? N - 1 : N;
    float of_ks = 0;
    for (int i = 0; i < N - rows; i++)
#pragma GCC ivdep
        for (int a = i * N + first; a < i * N + last; a++) {
            int b = a + rows * N + columns;
            SPRING
            float h[3], of_size = 0, along = 0, of_u[3];
            for (int k = 0; k < 3; k++) { h[k] = of_force[k][a] - of_force[k][b]; of_size += h[k] * u[k]; }
            of_ks += of_size * (length - LENGTH);
            for (int k = 0; k < 3; k++) { of_u[k] = size * h[k] + KD * of_size * w[k]; along += of_u[k] * u[k]; }
            for (int k = 0; k < 3; k++) {
                float of_d = of_u[k] * inverse + (KS * of_size - along * inverse) * u[k], of_w = KD * of_size * u[k];
                of_x[k][a] -= of_d; of_x[k][b] += of_d; of_v[k][a] -= of_w; of_v[k][b] += of_w;
            }
        }
    return of_ks;
}

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

int main(void) {
    double least[2] = {1, 1};
    float of_ks = 0;
    for (int a = 0; a < P; a++) {
        x[0][a] = a / N + 0.01f * (a % 7), x[1][a] = a % N + 0.01f * (a % 5), x[2][a] = 0.01f * (a % 3);
        for (int k = 0; k < 3; k++) of_force[k][a] = 0.001f * (a % 11);
    }
    for (int round = 0; round < 2000; round++) {
        double begun = now();
        memset(force, 0, sizeof force);
        for (int s = 0; s < 4; s++) forward(SHIFTS[s][0], SHIFTS[s][1]);
        double between = now();
        memset(of_x, 0, sizeof of_x), memset(of_v, 0, sizeof of_v);
        for (int s = 0; s < 4; s++) of_ks += reverse(SHIFTS[s][0], SHIFTS[s][1]);
        double done = now();
        if (between - begun < least[0]) least[0] = between - begun;
        if (done - between < least[1]) least[1] = done - between;
    }
    printf("forward %.1f us, reverse %.1f us (%g, %g)\n", 1e6 * least[0], 1e6 * least[1], force[0][5], of_ks);
    return 0;
}
