// Runs an archive's stream from C++ with libtorch alone: argument 1 is the archive; prints the poses' shapes and one number.
#include <torch/script.h>

#include <iostream>

int main(int, char** arguments) {
    torch::InferenceMode guard;
    auto model = torch::jit::load(arguments[1]);
    auto state = model.get_method("start")({1, 5});
    auto orientation = torch::eye(3).expand({1, 6, 3, 3});
    auto acceleration = torch::zeros({1, 6, 3});
    torch::Tensor last;
    for (int frame = 0; frame < 8; frame++) {
        auto result = model.get_method("stream")({orientation, acceleration, state}).toTuple();
        state = result->elements()[2];
        last = result->elements()[0].toTensor();
        std::cout << last.size(1) << " ";
    }
    auto left = model.get_method("drain")({state}).toTuple();
    std::cout << left->elements()[0].toTensor().size(1) << " " << last[0][0][1][0][0].item<float>() << std::endl;
}
