#!/usr/bin/env python3
"""Golden values of losses and derivatives, by PyTorch in double.

Writes pytorch.json beside this script: for models of both cases and a curl-free output the loss, its gradient, a
Hessian-vector product and the second-order meta-gradient of two inner steps, all from PyTorch's automatic
differentiation of an implementation of its own. Needs Debian's python3-torch.

  usage: /usr/bin/python3 tests/golden/generate.py
"""
import json
import os

import torch

torch.set_default_dtype(torch.float64)
torch.manual_seed(20)

ACTIVATIONS = {
    "TANH": torch.tanh,
    "ELU": torch.nn.functional.elu,
    "SWISH": torch.nn.functional.silu,
    "MISH": torch.nn.functional.mish,
    "SOFTPLUS": torch.nn.functional.softplus,
}


def block_parameters(name, widths, inputs, outputs):
    parameters = {}
    for layer, width in enumerate(widths + [outputs]):
        parameters[f"{name}.{layer}.weight"] = 0.6 * torch.randn(width, inputs)
        parameters[f"{name}.{layer}.bias"] = 0.3 * torch.randn(width)
        inputs = width
    return parameters


def apply_block(parameters, name, spec, x):
    layers = len(spec.get("hidden_widths", [])) + 1
    for layer in range(layers):
        x = x @ parameters[f"{name}.{layer}.weight"].T + parameters[f"{name}.{layer}.bias"]
        if layer < layers - 1:
            x = ACTIVATIONS[spec["activation"]](x)
    return x


def advance(model, p, latent, u):
    """The transition: row vectors, a row per rollout."""
    t = model["transition"]
    form, bypass = t["form"], t["bypass"]
    if form == "JOINT":
        result = apply_block(p, "transition", t["block"], torch.cat([latent, u], -1))
    else:
        result = apply_block(p, "transition", t["block"], latent)
    if form == "ADDITIVE":
        result = result + apply_block(p, "transition_input", t["input_block"], u)
    if bypass == "SKIP":
        result = result + latent
    if bypass == "LINEAR":
        result = result + latent @ p["transition.state_bypass.weight"].T
        if form != "AUTONOMOUS":
            result = result + u @ p["transition.input_bypass.weight"].T
    return result


def mse(a, b):
    return ((a - b) ** 2).mean()


def case_one_loss(model, loss, p, data, first, samples):
    u, y, window, horizon = data["u"], data["y"], model["window"], loss["horizon"]
    total_y, total_r = [], []
    starts = range(first + window - 1, first + samples - horizon, loss["stride"])
    shift = 1 if model["transition"]["input_time"] == "NEXT" else 0
    for t in starts:
        rows = [torch.cat([u[s], y[s]]) for s in range(t - window + 1, t + 1)]
        latent = apply_block(p, "encoder", model["encoder"], torch.cat(rows))
        total_r.append((apply_block(p, "output_decoder", model["output_decoder"], latent) - y[t]) ** 2)
        for k in range(horizon):
            latent = advance(model, p, latent, u[t + k + shift])
            total_y.append((apply_block(p, "output_decoder", model["output_decoder"], latent) - y[t + k + 1]) ** 2)
    return loss["output_weight"] * torch.stack(total_y).mean() + loss["reconstruction_weight"] * torch.stack(total_r).mean()


def case_two_loss(model, loss, p, data, first, samples):
    u, y, x, horizon = data["u"], data["y"], data["x"], loss["horizon"]
    curl_free = model.get("output_constraint", {}).get("curl_free", {}).get("position_states")
    recon, state_errors, output_errors = [], [], []
    for t in range(first, first + samples - horizon, loss["stride"]):
        state = x[t]
        if not state.requires_grad:
            state = state.clone().requires_grad_(True)
        for k in range(horizon):
            latent = apply_block(p, "encoder", model["encoder"], torch.cat([state, u[t + k]]))
            if k == 0:
                recon.append((apply_block(p, "state_decoder", model["state_decoder"], latent) - x[t]) ** 2)
            output = apply_block(p, "output_decoder", model["output_decoder"], latent)
            if curl_free is not None:
                gradient = torch.autograd.grad(output.sum(), state, create_graph=True)[0]
                output = gradient[curl_free]
            output_errors.append((output - y[t + k]) ** 2)
            state = apply_block(p, "state_decoder", model["state_decoder"], advance(model, p, latent, u[t + k]))
            state_errors.append((state - x[t + k + 1]) ** 2)
    return (
        loss["reconstruction_weight"] * torch.stack(recon).mean()
        + loss["state_weight"] * torch.stack(state_errors).mean()
        + loss["output_weight"] * torch.stack(output_errors).mean()
    )


def gradient_of(value, parameters, create_graph=False):
    """Zero where a parameter does not matter, as the offset of a potential."""
    found = torch.autograd.grad(value, parameters, create_graph=create_graph, allow_unused=True)
    return [torch.zeros_like(p) if g is None else g for g, p in zip(found, parameters)]


def golden_case(name, model, loss):
    one = model["case"] == "INPUT_OUTPUT"
    n_u, n_y, n_x, n = model["input_size"], model["output_size"], model.get("state_size", 0), model["latent_size"]
    t = model["transition"]
    widths = lambda spec: spec.get("hidden_widths", [])
    p = block_parameters("encoder", widths(model["encoder"]), model["window"] * (n_u + n_y) if one else n_x + n_u, n)
    p |= block_parameters("transition", widths(t["block"]), n + (n_u if t["form"] == "JOINT" else 0), n)
    if t["form"] == "ADDITIVE":
        p |= block_parameters("transition_input", widths(t["input_block"]), n_u, n)
    if t["bypass"] == "LINEAR":
        p["transition.state_bypass.weight"] = 0.5 * torch.randn(n, n)
        if t["form"] != "AUTONOMOUS":
            p["transition.input_bypass.weight"] = 0.5 * torch.randn(n, n_u)
    if not one:
        p |= block_parameters("state_decoder", widths(model["state_decoder"]), n, n_x)
    curl_free = "output_constraint" in model
    p |= block_parameters("output_decoder", widths(model["output_decoder"]), n, 1 if curl_free else n_y)
    length, samples = 24, 10
    data = {"u": torch.randn(length, n_u), "y": torch.randn(length, n_y), "x": torch.randn(length, n_x)}
    function = case_one_loss if one else case_two_loss

    names = list(p)
    values = [p[k].requires_grad_(True) for k in names]
    direction = [torch.randn_like(v) for v in values]
    value = function(model, loss, p, data, 0, samples)
    gradient = gradient_of(value, values, create_graph=True)
    slope = sum((g * d).sum() for g, d in zip(gradient, direction))
    product = gradient_of(slope, values)

    rate, adapted = 0.02, values
    for _ in range(2):
        inner = function(model, loss, dict(zip(names, adapted)), data, 0, samples)
        steps = gradient_of(inner, adapted, create_graph=True)
        adapted = [a - rate * s for a, s in zip(adapted, steps)]
    target = function(model, loss, dict(zip(names, adapted)), data, 12, samples)
    meta_gradient = gradient_of(target, values)

    flat = lambda tensors: {k: v.detach().reshape(-1).tolist() for k, v in zip(names, tensors)}
    return {
        "name": name,
        "model": model,
        "loss": loss,
        "samples": samples,
        "target_first": 12,
        "inner_lr": rate,
        "inner_steps": 2,
        "u": data["u"].tolist(),
        "y": data["y"].tolist(),
        "x": data["x"].tolist(),
        "parameters": flat(values),
        "direction": flat(direction),
        "value": value.item(),
        "gradient": flat(gradient),
        "hessian_vector": flat(product),
        "target_value": target.item(),
        "meta_gradient": flat(meta_gradient),
    }


def main():
    block = lambda widths, activation: {"hidden_widths": widths, "activation": activation}
    one = {
        "case": "INPUT_OUTPUT", "input_size": 1, "output_size": 2, "latent_size": 3, "window": 3,
        "encoder": block([4], "ELU"), "output_decoder": block([3], "MISH"), "precision": "FLOAT64",
        "transition": {"block": block([4], "TANH"), "form": "JOINT", "bypass": "LINEAR", "input_time": "NEXT"},
    }
    two = {
        "case": "STATE_INPUT_OUTPUT", "input_size": 1, "output_size": 2, "state_size": 3, "latent_size": 4,
        "encoder": block([5], "SOFTPLUS"), "state_decoder": block([4], "TANH"), "output_decoder": block([4], "SWISH"),
        "precision": "FLOAT64", "window": 1,
        "transition": {"block": block([3], "SWISH"), "input_block": block([2], "TANH"), "form": "ADDITIVE",
                       "bypass": "SKIP", "input_time": "CURRENT"},
    }
    curl = json.loads(json.dumps(two))
    curl["output_constraint"] = {"curl_free": {"position_states": [0, 2]}}
    curl["transition"] = {"block": block([3], "SWISH"), "form": "AUTONOMOUS", "bypass": "NONE", "input_time": "CURRENT"}
    loss_one = {"horizon": 3, "rollout": "LATENT", "stride": 2, "output_weight": 1.5, "reconstruction_weight": 0.5}
    loss_two = {"horizon": 3, "rollout": "STATE", "stride": 2, "output_weight": 1.5, "state_weight": 0.75,
                "reconstruction_weight": 0.5}
    cases = [golden_case("Case I", one, loss_one), golden_case("Case II", two, loss_two),
             golden_case("curl-free", curl, loss_two)]
    path = os.path.join(os.path.dirname(os.path.abspath(__file__)), "pytorch.json")
    with open(path, "w") as file:
        json.dump({"torch": torch.__version__, "cases": cases}, file, separators=(",", ":"))
        file.write("\n")


if __name__ == "__main__":
    main()
