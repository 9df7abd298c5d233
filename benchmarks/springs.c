/* One thread, explicit Euler, forces added up spring by spring: the program that one would write by hand. */
#include <math.h>
#include <string.h>

void run(int steps, int particles, int springs, const int *edges, const float *rest, float ks, float kd, float dt,
         float gravity, float drag, float *restrict x, float *restrict v, float *restrict f)
{
    for (int step = 0; step < steps; step++) {
        memset(f, 0, 3 * particles * sizeof(float));
        for (int e = 0; e < springs; e++) {
            const int i = 3 * edges[2 * e], j = 3 * edges[2 * e + 1];
            const float dx = x[i] - x[j], dy = x[i + 1] - x[j + 1], dz = x[i + 2] - x[j + 2];
            const float sx = v[i] - v[j], sy = v[i + 1] - v[j + 1], sz = v[i + 2] - v[j + 2];
            const float r = sqrtf(dx * dx + dy * dy + dz * dz), inverse = r > 0 ? 1 / r : 0;
            const float approach = (sx * dx + sy * dy + sz * dz) * inverse;
            const float c = (ks * (rest[e] - r) - kd * approach) * inverse;
            f[i] += c * dx, f[i + 1] += c * dy, f[i + 2] += c * dz;
            f[j] -= c * dx, f[j + 1] -= c * dy, f[j + 2] -= c * dz;
        }
        for (int i = 0; i < particles; i++) {
            float *p = x + 3 * i, *w = v + 3 * i, *a = f + 3 * i;
            const float speed = drag == 0 ? 0 : drag * sqrtf(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
            for (int k = 0; k < 3; k++) {
                const float acceleration = a[k] - speed * w[k] - (k == 2 ? gravity : 0);
                p[k] += dt * w[k];
                w[k] += dt * acceleration;
            }
        }
    }
}
