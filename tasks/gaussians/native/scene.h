// The plain C data that cross the border to Python.
#pragma once

#include <cstdint>

extern "C" {

struct Scene {
    int64_t count;
    const float* means;           // [N, 3] world
    const float* quaternions;     // [N, 4] w x y z, any length
    const float* log_scales;      // [N, 3]
    const float* opacity_logits;  // [N]
    const float* sh;              // [N, sh_coefficients, 3]
    const int32_t* labels;        // [N] the label of each Gaussian, < 0 = none; null without labels
    const int32_t* ids;           // [H, W] the label that each pixel should show; null without `mismatch`
    int32_t sh_coefficients;      // stored
    int32_t sh_degree;            // used, 0..3
    int32_t num_labels;
    int32_t width, height;
    double fx, fy, cx, cy;
    double borders[4];            // of the whole photo: x / z of the left, y / z of the upper, x / z of the right, y / z
                                  // of the lower one
    double world_to_camera[12];   // rows of [R | t]
    double near_plane;
    float background[3];
};

// Outputs of the forward pass, or gradients towards them (null = zero).
struct Images {
    float* rgb;        // [H, W, 3] over the background
    float* alpha;      // [H, W]
    float* depth;      // [H, W] sum of weight * z
    float* masks;      // [num_labels, H, W] sum of the weights of each label; null when not wanted
    float* mismatch;   // [H, W] sum of the weights of labels other than the pixel's, less those of its own; likewise
    int32_t* top;      // [H, W] row of the largest weight, -1 = none; likewise
    float* radii;      // [N] pixels, 0 = not in view
    float* strongest;  // [N] largest weight over the image; null when not wanted
};

struct Gradients {
    float* means;
    float* quaternions;
    float* log_scales;
    float* opacity_logits;
    float* sh;
    float* centers;     // [N, 2] towards the projected mean, pixels
    float* background;  // [3]
};

// A parameter as Adam moves it; arrays are [N, width].
struct Learnt {
    float* value;
    const float* gradient;
    float* first;               // moments
    float* second;
    const float* paces;         // [N] the rate of each row, of all its values; null: the two below
    int64_t width;
    int64_t active;             // the values of a row after these stay
    int64_t head;               // how many of them have a rate of their own
    double head_rate, rate;
};
}
