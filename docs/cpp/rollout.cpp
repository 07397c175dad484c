// Rolls an exported model of one material of particles out in a box, with LibTorch and without Python; prepare.py writes what it reads.
// The program makes the step. This file finds the edges and islands before it, and puts particles back into the box after it.
#include <ATen/ATen.h>
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>
#include <torch/serialize.h>

#include <fstream>
#include <iostream>
#include <iterator>
#include <map>

// Pairs within the radius, each once: rows of source and target [2, pair]. Use a cell list instead for more than a few thousand particles.
at::Tensor pairs(const at::Tensor& source, const at::Tensor& target, double radius, bool is_same) {
  auto near = (source.unsqueeze(1) - target.unsqueeze(0)).square().sum(-1) <= radius * radius;
  return (is_same ? near.triu(1) : near).nonzero().t().contiguous();
}

// Number of the connected group of each particle.
at::Tensor islands(const at::Tensor& edges, int64_t count) {
  auto label = at::arange(count);
  for (at::Tensor before; !before.defined() || !label.equal(before);) {
    before = label;
    label = label.scatter_reduce(0, edges[1], label.index({edges[0]}), "amin");
    label = label.scatter_reduce(0, edges[0], label.index({edges[1]}), "amin");
  }
  return std::get<1>(at::_unique(label, true, true));
}

int main(int argc, char** argv) {
  if (argc != 5) {
    std::cerr << "usage: rollout MODEL.pt2 SCENE.pt STEPS POSITIONS.bin\n";
    return 1;
  }
  at::NoGradGuard no_gradients;
  torch::inductor::AOTIModelPackageLoader model(argv[1]);
  std::ifstream file(argv[2], std::ios::binary);
  auto loaded = torch::pickle_load(std::vector<char>(std::istreambuf_iterator<char>(file), {})).toGenericDict();
  auto about = loaded.at("about").toGenericDict();
  std::vector<std::string> order;
  std::map<std::string, at::Tensor> scene;
  for (const auto& item : loaded.at("inputs").toGenericDict()) {
    order.push_back(item.key().toStringRef());
    scene[order.back()] = item.value().toTensor();
  }
  const std::string material = order[1].substr(order[1].find('.') + 1);  // the inputs begin with gravity and pos.MATERIAL
  auto& pos = scene["pos." + material];
  auto& history = scene["velocity_history." + material];
  const double radius = about.at("radius").toTensor().item<double>(), dt = about.at("frame_dt").toTensor().item<double>();
  std::ofstream out(argv[4], std::ios::binary);
  for (int step = 0, last = std::stoi(argv[3]); step <= last; ++step) {
    out.write(static_cast<const char*>(pos.contiguous().data_ptr()), pos.nbytes());
    auto edges = pairs(pos, pos, radius, true), touching = pairs(scene["boundary.pos"], pos, radius, false);
    scene["edges." + material + ".radius." + material] = edges;
    scene["edges.boundary.radius." + material] = touching;
    if (scene.count("num_islands")) {
      auto island = scene["island." + material] = islands(edges, pos.size(0));
      scene["num_islands"] = at::empty({island.max().item<int64_t>() + 1, 0}, at::kDouble);
    }
    std::vector<at::Tensor> inputs;
    for (const auto& name : order) inputs.push_back(scene[name]);
    auto moved = model.run(inputs);  // positions, velocity history, accelerations
    auto shift = at::clamp(moved[0], about.at("low").toTensor(), about.at("high").toTensor()) - moved[0];  // containment
    pos = moved[0] + shift;
    history = moved[1].clone();
    history.select(1, -1).add_(shift / dt);
  }
}
