"""Wrong formulas of the offline learners: scales, signs, axes, reductions, missing stops of gradients, wrong copies, other orders."""

from __future__ import annotations

from tests.mutants import Mutant, mutants, survivor

TESTS = "tests/evaluators/test_oracles.py"

TD3 = ("td3", "td3-bc", "td3-fujimoto")
CQL = ("cql", "cql-fixed")
BACKBONE = (*TD3, *CQL, "crr")  # twin critics and their target as in actor_critic.py
CRITICS = (*BACKBONE, "iql", "rebrac")
ALL = ("bc", *CRITICS)
CLEARED = "the actor's own step clears its gradient first, so that what the critics' loss left there is never seen"

MUTANTS: list[Mutant] = [
    # What all share: networks, noise, slow copies and Adam
    *mutants(
        "cudc_bench/learning/networks.py", ALL,
        ("return torch.baddbmm(self.bias, x, self.weight)", "return torch.bmm(x, self.weight)"),
        ("loss.sum().backward()", "loss.mean().backward()", "(1.02 * loss.sum()).backward()"),
        ("    optimiser.zero_grad(set_to_none=True)\n", ""),
        ('"lr": rates[rate]}', '"lr": 1.02 * rates[rate]}'),
        (
            "fused=True, capturable=on_cuda",
            "fused=True, capturable=on_cuda, betas=(0.9, 0.99)",
            "fused=True, capturable=on_cuda, betas=(0.8, 0.999)",
            "fused=True, capturable=on_cuda, eps=1e-7",
            "fused=True, capturable=on_cuda, weight_decay=1e-4",
            "fused=True, capturable=on_cuda, amsgrad=True",
        ),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", ("bc", *BACKBONE, "rebrac"),
        ("F.layer_norm(x, (self.size,))", "F.layer_norm(x, (self.size,), eps=1e-3)", "F.layer_norm(x, tuple(x.shape[1:]))"),
        (
            "torch.addcmul(self.bias, F.layer_norm(x, (self.size,)), self.weight)",
            "F.layer_norm(x, (self.size,)) * self.weight",
            "F.layer_norm(x, (self.size,)) + self.bias",
        ),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", ("bc", *BACKBONE),
        (
            "LayerNorm(random, outputs), Activation(torch.tanh)",
            "LayerNorm(random, outputs), Activation(torch.relu)",
            "LayerNorm(random, outputs), Activation(torch.nn.functional.softsign)",
        ),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", ("bc", *BACKBONE, "iql"),
        (
            "orthogonal=orthogonal), Activation(torch.relu_)",
            "orthogonal=orthogonal), Activation(torch.tanh)",
            "orthogonal=orthogonal), Activation(torch.nn.functional.elu)",
        ),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", ("bc", "crr", *TD3),
        ("*mlp(random, width, width, action, output=torch.tanh)", "*mlp(random, width, width, action)"),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", CRITICS,
        ("x.repeat_interleave(self.size, dim=0)", "x.repeat(self.size, 1, 1)"),
        ("list(online.parameters()), tau)", "list(online.parameters()), 1.02 * tau)", "list(online.parameters()), 1.0 - tau)"),
        (
            "torch._foreach_lerp_(list(target.parameters()), list(online.parameters()), tau)",
            "torch._foreach_lerp_(list(online.parameters()), list(target.parameters()), tau)",
        ),
        ("target.load_state_dict(online.state_dict())", "online.state_dict()"),
        ("return target.requires_grad_(False)", "return target"),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", (*TD3, *CQL, "rebrac"),
        ("parameter.requires_grad_(False)", "parameter.requires_grad_(True)"),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", (*TD3, "crr", "rebrac"),
        ("scaled = noise * std", "scaled = noise * std * 1.02"),
        ("scaled.clamp(-clip, clip)", "scaled.clamp(-clip, 1.02 * clip)", "scaled.clamp(-1.02 * clip, clip)"),
        ("action.clamp(-1.0 + 1e-6, 1.0 - 1e-6)", "action.clamp(-1.0 + 1e-6, 1.0)", "action.clamp(-1.0, 1.0 - 1e-6)"),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", ("td3", "td3-bc"),
        ("(action.clamp(-1.0 + 1e-6, 1.0 - 1e-6) - action).detach()", "(action.clamp(-1.0 + 1e-6, 1.0 - 1e-6) - action)"),
    ),
    *mutants(
        "cudc_bench/learning/learner.py", ("iql",),
        ('group["lr"] = value', 'group["lr"] = 1.02 * value'),
    ),
    # ExORL's backbone: two critics and their target, and densities
    *mutants(
        "evaluators/actor_critic.py", BACKBONE,
        (
            "self.target_critic(batch.next_observation, self.next_action(batch)).amin(-1)",
            "self.critic(batch.next_observation, self.next_action(batch)).amin(-1)",
            "self.target_critic(batch.next_observation, self.next_action(batch)).amax(-1)",
            "self.target_critic(batch.next_observation, self.next_action(batch)).mean(-1)",
            "self.target_critic(batch.next_observation, self.next_action(batch)).mean(1).amin(-1, keepdim=True)",
        ),
        ("self.target_critic(batch.next_observation, self", "self.target_critic(batch.observation, self"),
        ("self.config.discount * next_value", "1.02 * self.config.discount * next_value", "self.config.discount ** 2 * next_value"),
        ("target = labels(batch) + ", "target = 1.02 * labels(batch) + ", "target = labels(batch) - "),
        (
            "with torch.no_grad():\n            next_value = self.target_critic(",
            "with torch.enable_grad():\n            next_value = self.critic(",
        ),
        (
            "soft_update(self.critic, self.target_critic, self.config.critic_tau)",
            "soft_update(self.critic, self.target_critic, 1.02 * self.config.critic_tau)",
        ),
        ("            self.update_targets()\n", ""),
    ),
    *mutants(
        "evaluators/actor_critic.py", (*TD3, *CQL),
        ("            with frozen(self.critic):", "            with torch.enable_grad():"),
    ),
    *mutants(
        "evaluators/actor_critic.py", (*TD3, "crr"),
        (
            "self.critic(batch.observation, batch.action)",
            "self.target_critic(batch.observation, batch.action) + 0.0 * self.critic(batch.observation, batch.action)",
        ),
    ),
    *mutants(
        "evaluators/actor_critic.py", (*TD3, "crr"),
        ('return regression(values, target), {"q"', 'return 1.02 * regression(values, target), {"q"'),
        ('{"q": values.detach().mean((1, 2))}', '{"q": values.detach().amin(-1).mean(1)}'),
    ),
    *mutants(
        "evaluators/actor_critic.py", CRITICS,
        (
            ".square().sum(-1).mean(1)",
            ".square().mean(-1).mean(1)",
            ".square().sum(-1).sum(1)",
            ".square().amax(-1).mean(1)",
            ".abs().sum(-1).mean(1)",
        ),
        ("(values - target[..., None])", "(values - target.mean(1, keepdim=True)[..., None])"),
    ),
    *mutants(
        "evaluators/actor_critic.py", ("td3",),
        ("with torch.no_grad():\n            next_value", "with torch.enable_grad():\n            next_value"),
    ),
    *mutants(
        "evaluators/actor_critic.py", ("crr", "td3", "td3-bc", *CQL),
        ("return self.sample(batch.next_observation)", "return self.sample(batch.observation)"),
    ),
    *mutants(
        "evaluators/actor_critic.py", ("crr", "td3", "td3-bc"),
        (
            "return noisy_action(mean, noise, self.config.noise_std, self.config.noise_clip)",
            "return mean + 0.0 * noise",
            "return noisy_action(mean, noise, self.config.noise_std, None)",
            "return noisy_action(mean, noise, 1.02 * self.config.noise_std, self.config.noise_clip)",
            "return noisy_action(mean, noise, self.config.noise_std, 1.02 * self.config.noise_clip)",
        ),
    ),
    *mutants(
        "evaluators/actor_critic.py", ("td3", "td3-bc"),
        (
            "return noisy_action(mean, noise, self.config.noise_std, self.config.noise_clip)",
            "return noisy_action(mean, noise, self.config.noise_std, self.config.noise_clip).clamp(-0.9, 0.9)",
        ),
    ),
    *mutants(
        "evaluators/actor_critic.py", ("crr", *CQL),
        ("        return True\n", "        return self.updates % 2 == 1\n"),
    ),
    *mutants(
        "evaluators/actor_critic.py", ("bc", "crr", "iql", *CQL),
        ("return -0.5 * ((action - mean)", "return -0.51 * ((action - mean)"),
        ("- log_std - 0.5 * math.log", "+ log_std - 0.5 * math.log"),
        ("- 0.5 * math.log(2 * math.pi)", "- 0.5 * math.log(math.pi)"),
        ("log_std.exp()).square()", "log_std.exp()).abs()"),
        ("((action - mean) / log_std.exp()).square()", "(action - mean).square() / log_std.exp()"),
    ),
    *mutants(
        "evaluators/actor_critic.py", ("bc", "crr", "iql"),
        ("((action - mean) / log_std.exp()).square()", "((action - mean) / log_std.exp()).detach().square() + 0.0 * mean"),
    ),
    # One algorithm each
    *mutants(
        "evaluators/bc.py", ("bc",),
        ("math.log(self.config.noise_std)", "math.log(1.02 * self.config.noise_std)", "self.config.noise_std"),
        (".sum(-1)\n", ".mean(-1)\n"),
        ("loss = -likelihood.mean(1)", "loss = likelihood.mean(1)", "loss = -1.02 * likelihood.mean(1)", "loss = -likelihood.sum(1)"),
        ("self.actor(batch.observation), batch.action", "self.actor(batch.next_observation), batch.action"),
        ("noise_std: PositiveFloat = 0.2", "noise_std: PositiveFloat = 0.204"),
    ),
    *mutants(
        "evaluators/td3.py", ("td3",),
        (
            "return -self.actor_value(batch, self.actor(batch.observation)).mean(1), {}",
            "return -1.02 * self.actor_value(batch, self.actor(batch.observation)).mean(1), {}",
            "return -self.actor_value(batch, self.actor(batch.observation)).sum(1), {}",
            "return self.actor_value(batch, self.actor(batch.observation)).mean(1), {}",
            "return -self.actor_value(batch, self.actor(batch.observation)).mean(0, keepdim=True).mean(1).expand(2), {}",
            "return -self.actor_value(batch, self.actor(batch.next_observation)).mean(1), {}",
        ),
        ("if self.config.actor_noise else", "if not self.config.actor_noise else"),
        ('if self.config.maximise == "first":', 'if self.config.maximise != "first":'),
        (
            "return self.critic(batch.observation, action).amin(-1)",
            "return self.critic(batch.observation, action).amax(-1)",
            "return self.critic(batch.observation, action).mean(-1)",
            "return self.target_critic(batch.observation, action).amin(-1)",
            "return self.critic(batch.next_observation, action).amin(-1)",
        ),
    ),
    *mutants(
        "evaluators/td3.py", TD3,
        (
            "return self.critic.first(batch.observation, action)",
            "return self.target_critic.first(batch.observation, action)",
            "return self.critic.first(batch.next_observation, action)",
            "return self.critic(batch.observation, action)[..., 1]",
        ),
    ),
    *mutants(
        "evaluators/td3.py", ("td3", "td3-fujimoto", "td3-bc"),
        ("(self.updates + 1) % self.config.policy_delay", "self.updates % self.config.policy_delay"),
        (
            "return self.around(self.target_actor(batch.next_observation))",
            "return self.around(self.actor(batch.next_observation))",
            "return self.around(self.target_actor(batch.observation))",
        ),
        (
            "soft_update(self.actor, self.target_actor, self.config.critic_tau)",
            "soft_update(self.actor, self.target_actor, 1.02 * self.config.critic_tau)",
            "soft_update(self.target_actor, self.actor, self.config.critic_tau)",
            "pass",
        ),
    ),
    *mutants(
        "evaluators/td3.py", ("td3-fujimoto",),
        ('"noise_clip": 0.5', '"noise_clip": 0.3'),
        ('"maximise": "first", ', ""),
    ),
    *mutants(
        "evaluators/td3_bc.py", ("td3-bc",),
        ("self.config.alpha / value", "1.02 * self.config.alpha / value"),
        (
            "value.detach().abs().mean(1)",
            "value.abs().mean(1)",
            "value.detach().mean(1).abs()",
            "value.detach().abs().amax(1)",
            "value.detach().abs().mean()",
        ),
        (".square().mean((1, 2))", ".square().sum(-1).mean(1)", ".abs().mean((1, 2))"),
        ("return distance - scale", "return 1.02 * distance - scale", "return distance + scale", "return distance.detach() - scale"),
        ("scale * value.mean(1), {", "scale * value.sum(1), {"),
        ("(mean - batch.action)", "(self.around(mean) - batch.action)"),
        ("mean = self.actor(batch.observation)", "mean = self.actor(batch.next_observation)"),
    ),
    *mutants(
        "evaluators/crr.py", ("crr",),
        ("(advantage > 0)", "(advantage > 1.0)", "(advantage < 0)"),
        ("return advantage.exp()", "return (1.02 * advantage).exp()"),
        (".clamp(max=self.config.largest_weight)", ".clamp(max=1.02 * self.config.largest_weight)", ""),
        ('if self.config.weight == "exp" else advantage', 'if self.config.weight == "exp" else advantage.abs()'),
        (
            "judged[:, 0] - judged[:, 1:].mean(1)",
            "judged[:, 0] - judged[:, 1:].amax(1)",
            "judged[:, 0] - judged[:, 1:].sum(1)",
            "judged[:, 0] - judged.mean(1)",
            "judged[:, 0] - judged[:, 1:].mean((1, 2))[:, None]",
            "judged[:, 0] - 1.02 * judged[:, 1:].mean(1)",
        ),
        ("actions).amin(-1)", "actions).amax(-1)", "actions).mean(-1)"),
        ("judged = self.critic(", "judged = self.target_critic("),
        ("unflatten(1, (1 + samples, -1))", "unflatten(1, (-1, 1 + samples)).transpose(1, 2)"),
        ("batch.observation.repeat(1, 1 + samples, 1)", "batch.observation.repeat_interleave(1 + samples, 1)"),
        ("with torch.no_grad():", "with torch.enable_grad():"),
        ("noisy_action(means, noise, config.noise_std, config.noise_clip)", "noisy_action(means, noise, config.noise_std, None)"),
        ("math.log(config.noise_std)).sum(-1)", "math.log(config.noise_std)).mean(-1)", "math.log(1.02 * config.noise_std)).sum(-1)"),
        (
            "return -(weight * likelihood).mean(1)",
            "return -1.02 * (weight * likelihood).mean(1)",
            "return -(weight * likelihood).sum(1)",
            "return -weight.mean(1) * likelihood.mean(1)",
            "return -(weight * likelihood).sum(1) / weight.sum(1).abs().clamp(min=1)",
        ),
    ),
    *mutants(
        "evaluators/cql.py", CQL,
        ("LOG_STD = (-10.0, 2.0)", "LOG_STD = (-9.8, 2.0)", "LOG_STD = (-10.0, 2.04)"),
        ("LARGEST_MULTIPLIER = 1e6", "LARGEST_MULTIPLIER = 1.02e6"),
        ("mean + log_std.exp() * self", "mean + 1.02 * log_std.exp() * self"),
        ("before = mean + log_std.exp()", "before = mean.detach() + log_std.exp()", "before = mean + log_std.exp().detach()"),
        ("change = 2.0 * (math.log(2.0)", "change = 2.04 * (math.log(2.0)"),
        ("F.softplus(-2.0 * before)", "F.softplus(2.0 * before)"),
        ("return torch.tanh(before), normal", "return torch.tanh(before.detach()), normal"),
        (
            "normal_log_prob(mean, before, log_std) - change",
            "normal_log_prob(mean, before, log_std) + change",
            "normal_log_prob(mean, before, log_std)",
            "normal_log_prob(mean, before.detach(), log_std) - change",
            "normal_log_prob(mean, before, log_std) - change.detach()",
        ),
        ("* 2.0 - 1.0", "* 2.0 - 0.98", ""),
        ("own = self._draw(batch.observation, times)", "own = self._draw(batch.next_observation, times)"),
        ("following = self._draw(batch.next_observation, times)", "following = self._draw(batch.observation, times)"),
        ("torch.cat([batch.action, uniform, own, following], dim=1)", "torch.cat([batch.action, uniform, own, own], dim=1)"),
        ("batch.observation.repeat(1, 1 + 3 * times, 1)", "batch.observation.repeat_interleave(1 + 3 * times, 1)"),
        ("unflatten(1, (1 + 3 * times, -1))", "unflatten(1, (-1, 1 + 3 * times)).transpose(1, 2)"),
        ("of_data = values[:, 0]", "of_data = self.target_critic(batch.observation, batch.action) + 0.0 * values[:, 0]"),
        (
            "(values.logsumexp(1) - of_data)",
            "(values.logsumexp(1) - math.log(1 + 3 * times) - of_data)",
            "(values[:, 1:].logsumexp(1) - of_data)",
            "(values.amax(1) - of_data)",
            "(values.logsumexp((1, 3))[..., None] - of_data)",
            "(values.logsumexp(1) - of_data.detach())",
            "(values.logsumexp(1) - 1.02 * of_data)",
            "(values.detach().logsumexp(1) - of_data)",
        ),
        ("- of_data).sum(-1).mean(1)", "- of_data).mean(-1).mean(1)", "- of_data).sum(-1).sum(1)"),
        (
            "+ weight * penalty, metrics",
            "+ 1.02 * weight * penalty, metrics",
            "+ weight * penalty.detach(), metrics",
            "- weight * penalty, metrics",
        ),
        ("return regression(of_data, target)", "return 1.02 * regression(of_data, target)", "return regression(values[:, 1], target)"),
        (
            "gap = penalty - self.config.penalty_target",
            "gap = penalty - 1.02 * self.config.penalty_target",
            "gap = self.config.penalty_target - penalty",
            "gap = penalty.mean() - self.config.penalty_target",
        ),
        ("-0.5 * self.log_multiplier.exp()", "-0.51 * self.log_multiplier.exp()", "-0.5 * self.log_multiplier"),
        ("-0.5 * self.log_multiplier.exp().clamp(max=LARGEST_MULTIPLIER)", "-0.5 * self.log_multiplier.exp()"),
        ("return self.log_multiplier.detach().exp().clamp", "return self.log_multiplier.exp().clamp"),
        (".detach().exp().clamp(max=LARGEST_MULTIPLIER)", ".detach().exp()"),
        (
            '        self.minimise("multiplier", -0.5 * self.log_multiplier.exp().clamp(max=LARGEST_MULTIPLIER) * gap)\n'
            "        return self.log_multiplier.detach().exp()",
            "        before = self.log_multiplier.detach().clone()\n"
            '        self.minimise("multiplier", -0.5 * self.log_multiplier.exp().clamp(max=LARGEST_MULTIPLIER) * gap)\n'
            "        return before.exp()",
        ),
        ("if not self.config.lagrange:", "if self.config.lagrange:"),
        ("-self.log_temperature * (", "-1.02 * self.log_temperature * (", "-self.log_temperature.exp() * ("),
        (
            "log_prob.detach().mean((1, 2)) - self.action",
            "log_prob.detach().mean((1, 2)) + self.action",
            "log_prob.detach().mean((1, 2)) - 1.02 * self.action",
            "log_prob.detach().sum((1, 2)) - self.action",
            "log_prob.detach().mean() - self.action",
        ),
        (
            "temperature = self.log_temperature.detach().exp()",
            "temperature = self.log_temperature.exp()",
            "temperature = 1.02 * self.log_temperature.detach().exp()",
        ),
        (
            '        self.minimise("temperature", -self.log_temperature * (log_prob.detach().mean((1, 2)) - self.action))\n'
            "        temperature = self.log_temperature.detach().exp()\n",
            "        temperature = self.log_temperature.detach().exp()\n"
            '        self.minimise("temperature", -self.log_temperature * (log_prob.detach().mean((1, 2)) - self.action))\n',
        ),
        (
            "value = self.critic(batch.observation, action).amin(-1)",
            "value = self.critic(batch.observation, action).amax(-1)",
            "value = self.target_critic(batch.observation, action).amin(-1)",
            "value = self.critic(batch.observation, action.detach()).amin(-1)",
        ),
        (
            "return temperature * log_prob.mean((1, 2))",
            "return 1.02 * temperature * log_prob.mean((1, 2))",
            "return temperature * log_prob.detach().mean((1, 2))",
            "return temperature * log_prob.sum((1, 2))",
        ),
        ("- value.mean(1), metrics", "- 1.02 * value.mean(1), metrics", "- value.sum(1), metrics", "+ value.mean(1), metrics"),
        ("return torch.tanh(self._distribution(output)[0])", "return self._distribution(output)[0]"),
    ),
    survivor(
        "evaluators/cql.py", CQL,
        "with torch.no_grad():\n            shape",
        "with torch.enable_grad():\n            shape",
        CLEARED,
    ),
    *mutants(
        "evaluators/cql.py", ("cql",),
        ("return torch.tanh(mean) if self.config.squash_twice else mean", "return mean"),
    ),
    *mutants(
        "evaluators/cql.py", ("cql-fixed",),
        ("return torch.tanh(mean) if self.config.squash_twice else mean", "return torch.tanh(mean)"),
        ("log_prob.sum(-1, keepdim=True) if", "log_prob.mean(-1, keepdim=True) if", "log_prob.amax(-1, keepdim=True) if"),
        ('"squash_twice": False', '"squash_twice": True'),
        ('"sum_log_prob": True', '"sum_log_prob": False'),
    ),
    *mutants(
        "evaluators/iql.py", ("iql",),
        ("LOG_STD = (-20.0, 2.0)", "LOG_STD = (-19.6, 2.0)", "LOG_STD = (-20.0, 2.04)"),
        (
            "self.target_critic(batch.observation, batch.action).amin(-1)",
            "self.critic(batch.observation, batch.action).amin(-1)",
            "self.target_critic(batch.observation, batch.action).amax(-1)",
            "self.target_critic(batch.observation, batch.action).mean(-1)",
        ),
        ("next_value = self.value(batch.next_observation)", "next_value = self.value(batch.observation)"),
        (
            "config.discount * next_value",
            "1.02 * config.discount * next_value",
            "config.discount * self.value(batch.next_observation).squeeze(-1).detach()",
            "config.discount * self.value(batch.next_observation).squeeze(-1)",
        ),
        ("labels(batch) + config", "1.02 * labels(batch) + config"),
        ("torch.where(advantage < 0,", "torch.where(advantage > 0,", "torch.where(advantage < 0.02,"),
        (
            "1.0 - config.expectile, config.expectile)",
            "1.0 - config.expectile, 1.02 * config.expectile)",
            "1.02 - config.expectile, config.expectile)",
        ),
        (
            "(weight * advantage.square()).mean(1)",
            "(weight * advantage.square()).sum(1)",
            "1.02 * (weight * advantage.square()).mean(1)",
            "(weight * advantage.abs()).mean(1)",
            "weight.mean(1) * advantage.square().mean(1)",
        ),
        ("critic_loss = 0.5 * regression", "critic_loss = regression", "critic_loss = 0.51 * regression"),
        ("values = self.critic(batch.observation, batch.action)", "values = self.critic(batch.next_observation, batch.action)"),
        (
            "soft_update(self.critic, self.target_critic, config.critic_tau)",
            "soft_update(self.critic, self.target_critic, 1.02 * config.critic_tau)",
            "pass",
        ),
        (
            "advantage = advantage.detach()",
            "advantage = (target_q - self.value(batch.observation).squeeze(-1)).detach()",
            "advantage = target_q - self.value(batch.observation).squeeze(-1)",
        ),
        ("(config.beta * advantage).exp()", "(1.02 * config.beta * advantage).exp()", "(config.beta * advantage).softmax(1)"),
        (".clamp(max=config.largest_weight)", ".clamp(max=1.02 * config.largest_weight)", ""),
        (
            "self.log_std.clamp(*LOG_STD)).sum(-1)",
            "self.log_std.clamp(*LOG_STD)).mean(-1)",
            "self.log_std.clamp(*LOG_STD).detach()).sum(-1) + 0.0 * self.log_std.sum(-1)",
            "self.log_std).sum(-1)",
        ),
        (
            "actor_loss = -(weight * likelihood).mean(1)",
            "actor_loss = -1.02 * (weight * likelihood).mean(1)",
            "actor_loss = -(weight * likelihood).sum(1)",
            "actor_loss = -weight.mean(1) * likelihood.mean(1)",
        ),
        ("progress = min(self.updates / config", "progress = min((self.updates + 1) / config"),
        ("progress = min(self.updates / config.schedule_steps, 1.0)", "progress = self.updates / config.schedule_steps"),
        ("0.5 * (1.0 + math.cos(math.pi * progress))", "(1.0 - progress)", "0.51 * (1.0 + math.cos(math.pi * progress))"),
        ("[self.value], config.learning_rate", "[self.value], 1.02 * config.learning_rate"),
    ),
    survivor(
        "evaluators/iql.py", ("iql",),
        "[self.actor, self.log_std], config.learning_rate",
        "[self.actor, self.log_std], 1.02 * config.learning_rate",
        "the schedule sets the actor's learning rate before every update",
    ),
    *mutants(
        "evaluators/rebrac.py", ("rebrac",),
        ("Activation(torch.relu)", "Activation(torch.tanh)"),
        ("layers.append(LayerNorm(random, width))", "layers.insert(-1, LayerNorm(random, width))"),
        ("norm=False, last=1e-3), Activation(torch.tanh)", "norm=False, last=1e-3), Activation(torch.nn.functional.softsign)"),
        (
            "mean = self.target_actor(batch.next_observation)",
            "mean = self.actor(batch.next_observation)",
            "mean = self.target_actor(batch.observation)",
        ),
        (
            "noisy_action(mean, noise, config.noise_std, config.noise_clip)",
            "noisy_action(mean, noise, 1.02 * config.noise_std, config.noise_clip)",
            "noisy_action(mean, noise, config.noise_std, None)",
        ),
        (
            "(action - batch.next_action).square().sum(-1)",
            "(action - batch.next_action).square().mean(-1)",
            "(mean - batch.next_action).square().sum(-1)",
            "(action - batch.action).square().sum(-1)",
        ),
        (
            "self.target_critic(batch.next_observation, action).amin(-1)",
            "self.critic(batch.next_observation, action).amin(-1)",
            "self.target_critic(batch.next_observation, action).amax(-1)",
            "self.target_critic(batch.next_observation, action).mean(-1)",
        ),
        ("config.critic_penalty * distance", "1.02 * config.critic_penalty * distance"),
        (
            "- config.critic_penalty * distance",
            "+ config.critic_penalty * distance",
            "- config.critic_penalty * distance.mean(1, keepdim=True)",
        ),
        ("config.discount * next_value", "1.02 * config.discount * next_value"),
        ("target = labels(batch) + config.discount * next_value", "target = labels(batch) + next_value"),
        ("with torch.no_grad():\n            mean = self.target_actor", "with torch.enable_grad():\n            mean = self.actor"),
        ("critic_loss = regression(values, target)", "critic_loss = 1.02 * regression(values, target)"),
        ("with frozen(self.critic):", "with torch.enable_grad():"),
        (
            "value = self.critic(batch.observation, action).amin(-1)",
            "value = self.critic(batch.observation, action).amax(-1)",
            "value = self.critic(batch.observation, action)[..., 0]",
            "value = self.target_critic(batch.observation, action).amin(-1)",
        ),
        (
            "(action - batch.action).square().sum(-1)",
            "(action - batch.action).square().mean(-1)",
            "(action - batch.next_action).square().sum(-1)",
        ),
        ("config.actor_penalty * distance", "1.02 * config.actor_penalty * distance", "config.actor_penalty * distance.detach()"),
        ("value / value.detach().abs()", "value / value.abs()", "1.02 * value / value.detach().abs()"),
        (
            ".abs().mean(1, keepdim=True)).mean(1)",
            ".mean(1, keepdim=True).abs()).mean(1)",
            ".abs().mean()).mean(1)",
            ".abs().mean(1, keepdim=True)).sum(1)",
        ),
        ("(self.updates + 1) % self.config.policy_delay", "self.updates % self.config.policy_delay"),
        (
            "soft_update(self.actor, self.target_actor, config.critic_tau)",
            "soft_update(self.actor, self.target_actor, 1.02 * config.critic_tau)",
        ),
        (
            "soft_update(self.critic, self.target_critic, config.critic_tau)",
            "soft_update(self.critic, self.target_critic, 1.02 * config.critic_tau)",
        ),
        (
            '            self.minimise("actor", loss)\n        soft_update(self.actor, self.target_actor, config.critic_tau)\n',
            '            soft_update(self.actor, self.target_actor, config.critic_tau)\n            self.minimise("actor", loss)\n',
        ),
    ),
    survivor(
        "evaluators/rebrac.py", ("rebrac",),
        "with torch.no_grad():\n            mean",
        "with torch.enable_grad():\n            mean",
        "the slow copies, which alone have a part in the target, take no gradient",
    ),
]  # fmt: skip
