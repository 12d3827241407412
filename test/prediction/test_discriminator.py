# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the time-agnostic conditional GAN."""

import math

import pytest
from tap_ros.prediction.discriminator import (
    Discriminator,
    discriminator_loss,
    generator_loss,
    smoothed_labels,
)
from tap_ros.prediction.networks import PredictorConfig
import torch

SMALL = PredictorConfig(base_width=4)
STEP, OTHER = torch.tensor([2, 0, 5]), torch.tensor([3, 5, 5])  # 1, 5 and 0 steps apart


def logits(seed, batch=3, times=7):
    return torch.randn(batch, times, generator=torch.Generator().manual_seed(seed)) * 3


def certain(step, value, times=7):
    """Return logits that are `value` at `step`, and wrong everywhere else."""
    return torch.full((len(step), times), -value).scatter(1, step[:, None], value)


def pictures(batch, config=SMALL):
    size, generator = config.image_size, torch.Generator().manual_seed(0)
    drawn = torch.rand(batch, config.num_context + 1, 3, size, size, generator=generator) * 2 - 1
    return drawn[:, :-1], drawn[:, -1]


def test_labels_fall_by_a_quarter_a_step_on_both_sides():
    times = torch.arange(12)
    expected = [0, 0, .25, .5, .75, 1, .75, .5, .25, 0, 0, 0]
    assert smoothed_labels(torch.tensor(5), times - 1).tolist() == [0, *expected[:-1]]
    assert smoothed_labels(times, torch.tensor(5)).tolist() == expected
    assert smoothed_labels(torch.tensor(2), torch.arange(4), alpha=1).tolist() == [0, 0, 1, 0]


def test_knowing_nothing_costs_3_ln_2_and_a_perfect_answer_nothing_where_labels_are_hard():
    nothing = torch.zeros(3, 7)
    loss = discriminator_loss(nothing, nothing, nothing, STEP, OTHER)
    assert loss.item() == pytest.approx(3 * math.log(2))
    step, far = torch.tensor([0, 6, 2]), torch.tensor([4, 0, 6])
    yes, no = certain(step, 40.0), certain(step, -40.0)
    assert discriminator_loss(yes, no, no, step, far) < 1e-12
    assert discriminator_loss(yes, no, yes, step, step) < 1e-12
    assert discriminator_loss(no, yes, yes, step, far).item() == pytest.approx(120)


def test_a_smoothed_label_is_the_best_answer_beside_t():
    # The third term alone is lowest where the probability equals the label.
    step, beside = torch.tensor([2]), torch.tensor([3])
    yes, no = certain(step, 40.0), certain(step, -40.0)
    odds = torch.linspace(-3, 3, 601)
    losses = [discriminator_loss(yes, no, torch.full((1, 7), value), step, beside)
              for value in odds]
    assert odds[torch.stack(losses).argmin()].sigmoid() == pytest.approx(0.75, abs=2e-3)


def test_eq_11_is_written_out():
    real, generated, other = logits(1), logits(2), logits(3)
    terms = []
    for b, (t, t_other) in enumerate(zip(STEP, OTHER)):
        p_real, p_generated, p_other = (
            p[b, t].double().sigmoid() for p in (real, generated, other))
        label = max(0, 1 - 0.25 * abs(t - t_other))
        terms.append(-(p_real.log() + (1 - p_generated).log()
                       + label * p_other.log() + (1 - label) * (1 - p_other).log()))
    loss = discriminator_loss(real, generated, other, STEP, OTHER)
    assert loss.item() == pytest.approx(torch.stack(terms).mean().item(), rel=1e-5)


def test_only_the_discriminator_of_the_chosen_time_learns():
    inputs = [logits(seed).requires_grad_() for seed in range(3)]
    discriminator_loss(*inputs, STEP, OTHER).backward()
    generated = logits(4).requires_grad_()
    generator_loss(generated, STEP).backward()
    own = certain(STEP, 1.0) > 0
    for tensor in (*inputs, generated):
        assert (tensor.grad != 0).equal(own)
    real, fake, _ = (tensor.grad[own] for tensor in inputs)
    assert (real < 0).all() and (fake > 0).all()  # descent raises the real frames' logits


def test_the_generator_wants_a_higher_logit_at_its_time_and_nothing_else():
    low, high, elsewhere = logits(5), logits(5), logits(5)
    high += certain(STEP, 1.0).clamp(min=0)
    elsewhere -= certain(STEP, -1.0).clamp(min=0)
    assert generator_loss(high, STEP) < generator_loss(low, STEP)
    assert generator_loss(elsewhere, STEP) == generator_loss(low, STEP)


def test_the_generator_keeps_its_gradient_when_it_is_found_out():
    generated = certain(STEP, -60.0).requires_grad_()
    generator_loss(generated, STEP).backward()
    assert generated.grad.sum().item() == pytest.approx(-1)


def test_there_is_a_logit_for_each_target_time():
    for num_context, image_size in ((1, 32), (2, 64)):
        config = PredictorConfig(image_size=image_size, base_width=4, num_context=num_context)
        network = Discriminator(config, 38)
        assert network.encoder[0].in_channels == 3 * (num_context + 1)  # appendix C
        assert network(*pictures(2, config)).shape == (2, 38)


def test_every_weight_gets_a_gradient_and_so_do_the_pictures():
    network, (context, image) = Discriminator(SMALL, 5), pictures(4)
    image.requires_grad_()
    network(context, image).square().mean().backward()
    assert image.grad.abs().sum() > 0
    without = [name for name, weight in network.named_parameters()
               if weight.grad is None or not weight.grad.abs().sum() > 0]
    assert without == []


def test_memory_format_and_half_precision_change_little():
    torch.manual_seed(0)
    network, (context, image) = Discriminator(SMALL, 5).eval(), pictures(4)
    expected = network(context, image)
    network.to(memory_format=torch.channels_last)
    assert network(context, image).allclose(expected, atol=1e-6)
    with torch.autocast('cpu', torch.bfloat16):
        half = network(context, image)
    assert half.dtype == torch.float32
    assert half.allclose(expected, atol=0.04 * expected.abs().max().item())


def test_it_learns_to_tell_times_apart():
    # Frames that grow brighter with time; generated ones are dark.
    torch.manual_seed(0)
    config = PredictorConfig(image_size=16, base_width=4, num_context=1)
    network, T = Discriminator(config, 8), 8
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    context = torch.zeros(32, 1, 3, 16, 16)

    def frames(step):
        brightness = (step / (T - 1)).view(-1, 1, 1, 1).expand(-1, 3, 16, 16)
        return brightness + 0.1 * torch.randn(len(step), 3, 16, 16)

    for _ in range(60):
        step, other = torch.randint(0, T, (2, 32))
        answers = [network(context, picture) for picture in
                   (frames(step), frames(step) - 1, frames(other))]
        optimizer.zero_grad()
        discriminator_loss(*answers, step, other).backward()
        optimizer.step()
    answers = network(context, frames(torch.arange(32) % T))
    right = answers[torch.arange(32), torch.arange(32) % T]
    wrong = answers[torch.arange(32), (torch.arange(32) + T // 2) % T]
    assert (right > wrong).float().mean() > 0.9
