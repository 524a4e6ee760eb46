"""Wrong formulas of the collectors, for test_oracles.py: scales, signs, axes, reductions, missing stops of gradients, wrong copies, wrong
orders."""

from __future__ import annotations

from tests.mutants import Mutant, mutants, survivor

TESTS = "tests/collectors/test_oracles.py"

# The agent is the same in all of them: one that is nothing else, one whose critics give successor features, one that weighs samples.
AGENTS = ("icm", "aps", "cudc-kmix")
WEIGHTED = ("cudc", "cudc-kmix")
CLEARED = "the actor's own step clears its gradient first, so that what the critics' loss left there is never seen"

# Backbone

NETWORKS = [
    *mutants(
        "cudc_bench/learning/networks.py", AGENTS,
        ("hidden = torch.relu_(self.hidden(self.trunk", "hidden = torch.tanh(self.hidden(self.trunk"),
        ("hidden, self.out.weight * self.head_mask)", "hidden, self.out.weight)"),
        (
            "heads = torch.baddbmm(self.out.bias, hidden, self.out.weight * self.head_mask)",
            "heads = torch.bmm(hidden, self.out.weight * self.head_mask)",
        ),
        ("scaled = noise * std", "scaled = noise * std * 1.02"),
        ("scaled.clamp(-clip, clip)", "scaled.clamp(-clip, 1.02 * clip)", "scaled.clamp(-1.02 * clip, clip)"),
        ("list(online.parameters()), tau)", "list(online.parameters()), 1.02 * tau)", "list(online.parameters()), 1.0 - tau)"),
        ("return target.requires_grad_(False)", "return target"),
        ("target.load_state_dict(online.state_dict())", "online.state_dict()"),
        ("parameter.requires_grad_(False)", "parameter.requires_grad_(True)"),
        ("loss.sum().backward()", "loss.mean().backward()"),
        ("    optimiser.zero_grad(set_to_none=True)\n", ""),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", ("icm",),
        ("(action.clamp(-1.0 + 1e-6, 1.0 - 1e-6) - action).detach()", "(action.clamp(-1.0 + 1e-6, 1.0 - 1e-6) - action)"),
        ("action.clamp(-1.0 + 1e-6, 1.0 - 1e-6)", "action.clamp(-1.0 + 1e-6, 1.0)", "action.clamp(-1.0, 1.0 - 1e-6)"),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", ("aps",),
        ("heads.unflatten(-1, (2, self.outputs))", "heads.unflatten(-1, (self.outputs, 2)).transpose(-1, -2)"),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", ("disagreement",),
        ("x.repeat_interleave(self.size, dim=0)", "x.repeat(self.size, 1, 1)"),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", ("smm",),
        ("groups.setdefault(rate, [])", "groups.setdefault(learning_rate, [])"),
        ('"lr": rates[rate]}', '"lr": rates[max(rates)]}'),
    ),
    *mutants(
        "cudc_bench/learning/knn.py", ("apt", "be", "aps", "cic", "moss", "cudc"),
        ("alpha=-2.0)", "alpha=-2.04)"),
        ("torch.inf if exclude_self else 0.0", "0.0", "torch.inf"),
        ("squared.topk(neighbours,", "squared.topk(neighbours - 1,", "squared.topk(min(neighbours + 1, squared.shape[-1] - exclude_self),"),
        ("largest=False", "largest=True"),
        (".clamp_(min=0.0).sqrt_()", ".clamp_(min=0.0)"),
        ("squared += centred.square().sum(-1)[:, :, None]", "squared += centred.square().mean(-1)[:, :, None]"),
    ),
    *mutants(
        "cudc_bench/learning/knn.py", ("proto",),
        ("others = centred if among is None else among - mean", "others = centred if among is None else among"),
    ),
    survivor(
        "cudc_bench/learning/knn.py", ("proto",),
        "mean = points.mean(1, keepdim=True)",
        "mean = points.mean((0, 1), keepdim=True)",
        "distances do not change by a shift",
    ),
    *mutants(
        "cudc_bench/learning/knn.py", ("aps", "cic", "moss"),
        (
            "(distances / scale[:, None, None] - floor)",
            "(distances / scale.mean() - floor)",
            "(distances - floor)",
            "((distances - floor) / scale[:, None, None])",
            "(distances / scale[:, None, None] - 1.02 * floor)",
        ),
        (
            ".clamp(min=0.0).mean(-1).log1p()",
            ".mean(-1).log1p()",
            ".clamp(min=0.0).log1p().mean(-1)",
            ".clamp(min=0.0).sum(-1).log1p()",
            ".clamp(min=0.0).mean(-1)",
        ),
    ),
    *mutants(
        "cudc_bench/learning/running_mean_std.py", ("aps", "rnd", "cic", "be"),
        ("self.mean += share * difference", "self.mean += 1.02 * share * difference"),
        ("self.weight += count", "self.weight += 1"),
        ("values = values.flatten(1)", "values = values.flatten(1).roll(1, 0)"),
        ("1e-4, dtype=torch.float64", "1e-2, dtype=torch.float64"),
        ("difference = mean - self.mean", "difference = mean.mean() - self.mean"),
    ),
    *mutants(
        "cudc_bench/learning/running_mean_std.py", ("aps", "rnd", "cic", "be"),
        ("correction=min(1, count - 1)", "correction=0"),
        ("share * (1.0 - share) * difference.square()", "share * difference.square()", "share * (1.0 - share) * difference"),
        ("share * (variance - self.variance)", "1.02 * share * (variance - self.variance)"),
        ('self.register_buffer("variance", torch.ones(', 'self.register_buffer("variance", torch.zeros('),
        (
            "        self.variance += ",
            "        self.mean += share * difference\n"
            "        self.mean -= share * difference\n        difference = difference * (1.0 - share)\n        self.variance += ",
        ),
    ),
]  # fmt: skip

AGENT = [
    *mutants(
        "collectors/ddpg.py", AGENTS,
        (
            "target = reward + self.bootstrap(batch) * next_value",
            "target = reward + 1.02 * self.bootstrap(batch) * next_value",
            "target = 1.02 * reward + self.bootstrap(batch) * next_value",
            "target = reward - self.bootstrap(batch) * next_value",
            "target = reward.mean(1, keepdim=True) + self.bootstrap(batch) * next_value",
            "target = reward + self.bootstrap(batch) * next_value.mean(1, keepdim=True)",
        ),
        (
            "self.config.discount ** batch.horizon.",
            "1.02 * self.config.discount ** batch.horizon.",
            "self.config.discount ** self.k.",
            "self.config.discount ** batch.horizon.flip(0).",
            "self.config.discount ** (batch.horizon - 1).",
        ),
        (
            "self.value(self.target_critic, following, skill, self._policy(following, skill)).amin(-1)",
            "self.value(self.critic, following, skill, self._policy(following, skill)).amin(-1)",
            "self.value(self.target_critic, following, skill, self._policy(following, skill)).amax(-1)",
            "self.value(self.target_critic, following, skill, self._policy(following, skill)).mean(-1)",
            "self.value(self.target_critic, batch.observation, skill, self._policy(following, skill)).amin(-1)",
            "self.value(self.target_critic, following, skill, self._policy(batch.observation, skill)).amin(-1)",
        ),
        (
            "values = self.value(self.critic, batch.observation, skill, batch.action)",
            "values = self.value(self.critic, batch.next_observation, skill, batch.action)",
        ),
        (
            "(values - target[..., None]).square().sum(-1)",
            "(values - target[..., None]).square().mean(-1)",
            "(values - target[..., None]).square().amax(-1)",
            "(values - target[..., None]).abs().sum(-1)",
            "1.02 * (values - target[..., None]).square().sum(-1)",
            "(values - target[..., None].mean(0, keepdim=True)).square().sum(-1)",
        ),
        ("loss = (error if weight is None else weight * error).mean(1)", "loss = (error if weight is None else weight * error).sum(1)"),
        ('"reward": reward.mean(1), "q"', '"reward": reward.sum(1), "q"'),
        ('"q": values.detach().mean((1, 2))', '"q": values.detach().amin(-1).mean(1)'),
        (
            "            action = self._policy(batch.observation, batch.skill)\n",
            "            action = self._policy(batch.observation, batch.skill)\n            action = action.detach() + 0.0 * action\n",
            "            action = self._policy(batch.next_observation, batch.skill)\n",
        ),
        (
            "self.value(self.critic, batch.observation, batch.skill, action).amin(-1)",
            "self.value(self.target_critic, batch.observation, batch.skill, action).amin(-1)",
            "self.value(self.critic, batch.observation, batch.skill, action)[..., 0]",
            "self.value(self.critic, batch.observation, batch.skill, action).mean(-1)",
        ),
        (
            "loss = -(value if weight is None else weight * value).mean(1)",
            "loss = (value if weight is None else weight * value).mean(1)",
            "loss = -(value if weight is None else weight * value).sum(1)",
            "loss = -1.02 * (value if weight is None else weight * value).mean(1)",
        ),
        ("        with frozen(self.critic):\n            action", "        with torch.enable_grad():\n            action"),
        (
            "soft_update(self.critic, self.target_critic, self.config.critic_tau)",
            "soft_update(self.critic, self.target_critic, 1.02 * self.config.critic_tau)",
            "pass",
        ),
        (
            "        metrics |= self._update_critic(batch, reward, weight)\n        metrics |= self._update_actor(batch, weight)\n",
            "        metrics |= self._update_actor(batch, weight)\n        metrics |= self._update_critic(batch, reward, weight)\n",
        ),
        (
            "        metrics |= self._update_critic(batch, reward, weight)\n",
            "        soft_update(self.critic, self.target_critic, self.config.critic_tau)\n"
            "        metrics |= self._update_critic(batch, reward, weight)\n",
        ),
        ("        self.updates += 1\n", "        self.updates += 2\n"),
        (
            "noisy_action(mean, noise, self.config.noise_std, self.config.noise_clip)",
            "noisy_action(mean, noise, self.config.noise_std, None)",
            "mean + 0.0 * noise",
        ),
        (
            'self.add_optimiser("actor", [self.actor], config.learning_rate)',
            'self.add_optimiser("actor", [self.actor], 1.02 * config.learning_rate)',
        ),
        (
            'self.add_optimiser("critic", [self.critic], config.learning_rate)',
            'self.add_optimiser("critic", [self.critic], 1.02 * config.learning_rate)',
        ),
        (
            'self.random["act"].normal(self.sizes.action), self.config.noise_std, None)',
            'self.random["act"].normal(self.sizes.action), self.config.noise_std, self.config.noise_clip)',
            'self.random["noise"].normal(self.sizes.action), self.config.noise_std, None)',
        ),
        ("            return mean\n", "            return 1.02 * mean\n"),
        ("discount: UnitInterval = 0.99", "discount: UnitInterval = 0.98"),
        ("critic_tau: UnitInterval = 0.01", "critic_tau: UnitInterval = 0.005"),
        ("noise_std: NonNegativeFloat = 0.2", "noise_std: NonNegativeFloat = 0.1"),
        ("noise_clip: NonNegativeFloat = 0.3", "noise_clip: NonNegativeFloat = 0.5"),
        ("learning_rate: PositiveFloat = 1e-4", "learning_rate: PositiveFloat = 3e-4"),
    ),
    *mutants(
        "collectors/ddpg.py", ("icm", "apt", "rnd", "aps", "cudc", "smm"),
        ("horizon: PositiveInt = 3", "horizon: PositiveInt = 4"),
    ),
    survivor(
        "collectors/ddpg.py", AGENTS,
        "        with torch.no_grad():\n            following, skill = ",
        "        with torch.enable_grad():\n            following, skill = ",
        CLEARED,
    ),
    *mutants(
        "collectors/ddpg.py", ("icm", "cudc"),
        ('self.config.td_discount == "gamma"', 'self.config.td_discount != "gamma"'),
    ),
    *mutants(
        "collectors/ddpg.py", WEIGHTED,
        ("(error if weight is None else weight * error)", "error", "(error if weight is None else weight.mean(1, keepdim=True) * error)"),
        (
            "(error if weight is None else weight * error).mean(1)",
            "(error if weight is None else weight * error / weight.mean(1, keepdim=True)).mean(1)",
        ),
        ("(value if weight is None else weight * value)", "value", "(value if weight is None else weight.mean(1, keepdim=True) * value)"),
        ("metrics |= self._update_actor(batch, weight)", "metrics |= self._update_actor(batch, None)"),
    ),
    # The reward is that of the updated networks.
    *mutants(
        "collectors/ddpg.py", ("icm", "apt", "be", "aps", "rnd", "disagreement", "diayn", "cic"),
        (
            "            loss, metrics = self.auxiliary_loss(batch)\n"
            '            self.minimise("belief", loss)\n        with torch.no_grad():\n            reward = self.reward(batch)\n',
            "            loss, metrics = self.auxiliary_loss(batch)\n"
            "            with torch.no_grad():\n"
            '                reward = self.reward(batch)\n            self.minimise("belief", loss)\n        with torch.no_grad():\n',
        ),
    ),
    # SMM's have rates of their own.
    *mutants(
        "collectors/ddpg.py", (*AGENTS, "apt", "proto", "rnd", "disagreement", "diayn", "cic"),
        (
            'self.add_optimiser("belief", trained, config.learning_rate)',
            'self.add_optimiser("belief", trained, 1.02 * config.learning_rate)',
        ),
    ),
    *mutants(
        "collectors/ddpg.py", ("proto", "cudc"),
        ("        self.update_targets()\n", ""),
    ),
]  # fmt: skip

LAYERS = [
    *mutants(
        "collectors/icm.py", ("icm",),
        ("mlp(random, s + a, width, s)", "mlp(random, s + a, width, width, s)"),
        ("mlp(random, 2 * s, width, a,", "mlp(random, 2 * s, width, width, a,"),
    ),
    *mutants(
        "collectors/apt.py", ("apt", "be"),
        ("mlp(random, z + a, width, z)", "mlp(random, z + a, width, width, z)"),
        ("mlp(random, 2 * z, width, a,", "mlp(random, 2 * z, z, a,"),
        ("feature_dim: PositiveInt = 512", "feature_dim: PositiveInt = 256"),
    ),
    *mutants(
        "collectors/proto.py", ("proto",),
        ("mlp(random, config.feature_dim, config.projection_hidden, config", "mlp(random, config.feature_dim, config.feature_dim, config"),
        ("prototypes: PositiveInt = 512", "prototypes: PositiveInt = 256"),
        ("F.normalize(drawn.transpose(1, 2), dim=-1)", "drawn.transpose(1, 2)"),
        (
            "make_target(self.predictor, Linear(random, s, config.feature_dim))",
            "Linear(random, s, config.feature_dim).requires_grad_(False)",
        ),
    ),
    *mutants(
        "collectors/aps.py", ("aps",),
        ("config.width, config.width, config.task_dim)", "config.width, config.task_dim)"),
    ),
    *mutants(
        "collectors/rnd.py", ("rnd",),
        ("self.config.width, self.config.width, self.config.feature_dim)", "self.config.width, self.config.feature_dim)"),
    ),
    *mutants(
        "collectors/disagreement.py", ("disagreement",),
        ("models: Annotated[int, Field(ge=2, le=1000)] = 5", "models: int = 4"),
    ),
    *mutants(
        "collectors/diayn.py", ("diayn",),
        ("width, width, self.config.skills)", "width, self.config.skills)"),
        ("skill_every: NonNegativeInt = 50", "skill_every: NonNegativeInt = 10"),
    ),
    *mutants(
        "collectors/smm.py", ("smm",),
        ("hidden, hidden, inputs)", "hidden, inputs)"),
        ("config.width, config.width, config.skills)", "config.width, config.skills)"),
        ("skill_every: NonNegativeInt = 0", "skill_every: NonNegativeInt = 50"),
    ),
    *mutants(
        "collectors/cic.py", ("cic",),
        ("self.skill_network = mlp(random, config.skill_dim, width, width,", "self.skill_network = mlp(random, config.skill_dim, width,"),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc", "cudc-no-reach", "cudc-reach"),
        ("mlp(random, s + a + self.horizons, width, s)", "mlp(random, s + a + self.horizons, width, width, s)"),
        ("config.action_hidden, config.action_hidden, a)", "config.action_hidden, a)"),
        ("mlp(random, 2 * s, width, self.horizons)", "mlp(random, 2 * s, width, width, self.horizons)"),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc", "cudc-reach"),
        ("projection_hidden: PositiveInt = 128", "projection_hidden: PositiveInt = 64"),
        ("make_target(self.state_encoder, self._state_encoder(random))", "self._state_encoder(random).requires_grad_(False)"),
        ("return random.uniform(size, size)", "return random.uniform(size, size) - 0.5"),
    ),
    *mutants(
        "cudc_bench/learning/networks.py", AGENTS,
        (
            "block.copy_(nn.init.orthogonal_(drawn, generator=generator).T)",
            "block.copy_(1.4 * nn.init.orthogonal_(drawn, generator=generator).T)",
        ),
        ("for block in member.chunk(blocks, dim=1):", "for block in [member]:"),
        ("bias = torch.zeros(random.count, 1, outputs,", "bias = 0.1 + torch.zeros(random.count, 1, outputs,"),
        ("self.hidden = Linear(random, width, 2 * width, blocks=2)", "self.hidden = Linear(random, width, 2 * width)"),
    ),
]  # fmt: skip

METHODS = [
    # ICM
    *mutants(
        "collectors/icm.py", ("icm",),
        (
            "(batch.next_observation - predicted).norm(dim=-1)",
            "(batch.next_observation - predicted).square().sum(-1)",
            "(batch.next_observation - predicted).norm(dim=1, keepdim=True).mean(-1)",
            "(batch.next_observation - batch.observation - predicted).norm(dim=-1)",
            "1.02 * (batch.next_observation - predicted).norm(dim=-1)",
            "(batch.next_observation - predicted).abs().sum(-1)",
        ),
        (
            "torch.cat([batch.observation, batch.next_observation], dim=-1)",
            "torch.cat([batch.next_observation, batch.observation], dim=-1)",
        ),
        (
            "(batch.action - inferred).norm(dim=-1).mean(1)",
            "1.02 * (batch.action - inferred).norm(dim=-1).mean(1)",
            "(batch.action - inferred).square().sum(-1).mean(1)",
            "(batch.action - inferred).norm(dim=-1).sum(1)",
        ),
        ('"loss_forward": self.forward_error(batch).mean(1)', '"loss_forward": self.forward_error(batch).sum(1)'),
        (
            'losses["loss_forward"] + losses["loss_inverse"]',
            'losses["loss_forward"] + 1.02 * losses["loss_inverse"]',
            '0.8 * losses["loss_forward"] + losses["loss_inverse"]',
        ),
        ("width, a, output=torch.tanh)", "width, a)"),
        (
            "(self.config.reward_scale * self.forward_error(batch)).log1p()",
            "self.config.reward_scale * self.forward_error(batch).log1p()",
            "self.config.reward_scale * self.forward_error(batch)",
            "(1.02 * self.config.reward_scale * self.forward_error(batch)).log1p()",
        ),
        ("reward_scale: PositiveFloat = 1.0", "reward_scale: PositiveFloat = 2.0"),
    ),
    # APT and its controls
    *mutants(
        "collectors/apt.py", ("apt", "apt-k6", "apt-ksched", "be"),
        (
            "(z_next - predicted).norm(dim=-1).mean(1)",
            "(z_next.detach() - predicted).norm(dim=-1).mean(1)",
            "1.02 * (z_next - predicted).norm(dim=-1).mean(1)",
            "(z_next - predicted).norm(dim=-1).sum(1)",
            "(z_next - predicted).square().sum(-1).mean(1)",
            "(z - predicted).norm(dim=-1).mean(1)",
        ),
        (
            "(batch.action - inferred).norm(dim=-1).mean(1)",
            "1.02 * (batch.action - inferred).norm(dim=-1).mean(1)",
            "(batch.action - inferred).square().mean(-1).mean(1)",
        ),
        (
            "torch.cat([z, z_next], dim=-1)",
            "torch.cat([z.detach(), z_next], dim=-1)",
            "torch.cat([z, z_next.detach()], dim=-1)",
            "torch.cat([z_next, z], dim=-1)",
        ),
        ("torch.cat([z, batch.action], dim=-1)", "torch.cat([z.detach(), batch.action], dim=-1)"),
        ("width, a, output=torch.tanh)", "width, a)"),
        ('return losses["loss_forward"] + losses["loss_inverse"]', 'return losses["loss_forward"] + 0.98 * losses["loss_inverse"]'),
        ("z = self.represent(batch.observation)", "z = self.represent(batch.next_observation)"),
        (".mean(-1)\n\n    def reward", ".amax(-1)\n\n    def reward", ".sum(-1)\n\n    def reward"),
        ("neighbours: PositiveInt = 12", "neighbours: PositiveInt = 13"),
        ("knn_exclude_self: bool = False", "knn_exclude_self: bool = True"),
    ),
    *mutants(
        "collectors/apt.py", ("apt", "apt-k6", "apt-ksched"),
        ("return self.distance(batch).log1p()", "return self.distance(batch)", "return 1.02 * self.distance(batch).log1p()"),
    ),
    *mutants(
        "collectors/variants.py", ("apt-k6",),
        ('{"horizon": 6}', '{"horizon": 5}'),
    ),
    *mutants(
        "collectors/variants.py", ("apt-ksched",),
        (
            "(self.updates + 1) * self.sizes.update_every\n        self.k.copy_",
            "self.updates * self.sizes.update_every\n        self.k.copy_",
        ),
        ("(step >= self.k_steps).sum()", "(step > self.k_steps).sum()", "(step >= self.k_steps).any()"),
        ("(450_000, 650_000, 1_050_000)", "(450_000, 650_000, 1_000_000)"),
    ),
    # Behavioural entropy
    *mutants(
        "collectors/be.py", ("be",),
        ("math.log(config.feature_dim)", "math.log(config.width)"),
        ("math.log(config.feature_dim) ** (1.0 - config.alpha)", "math.log(config.feature_dim) ** (config.alpha - 1.0)", "1.0"),
        ("surprise.pow(config.alpha)", "surprise.pow(1.02 * config.alpha)", "surprise"),
        ("count = (-weighted).exp() * weighted", "count = (-1.02 * weighted).exp() * weighted", "count = (-weighted).exp() * surprise"),
        ("count * (1.0 + distance if", "count * (distance if"),
        ("else distance)\n", "else 1.0 + distance)\n"),
        (
            "        self.moments.add(distance)\n            distance = distance / self.moments.mean[:, None]",
            "        distance = distance / self.moments.mean[:, None]\n            self.moments.add(distance)",
        ),
        (
            "distance / self.moments.mean[:, None]",
            "distance / self.moments.variance.sqrt()[:, None]",
            "distance / self.moments.mean.mean()",
        ),
        (
            "(distance - config.distance_floor).clamp(min=0.0)",
            "(distance - config.distance_floor).abs()",
            "distance.clamp(min=config.distance_floor)",
        ),
        ("alpha: PositiveFloat = 0.5", "alpha: PositiveFloat = 0.8"),
        ('= field(default="one_plus_distance"', '= field(default="distance"'),
        ('field(default="none", metadata', 'field(default="running_mean", metadata'),
    ),
    # ProtoRL
    *mutants(
        "collectors/proto.py", ("proto",),
        ("        self.normalise_prototypes()\n        online", "        online"),
        ("        self.normalise_prototypes()\n        y = ", "        y = "),
        ("self.prototypes.copy_(F.normalize(self.prototypes, dim=-1))", "self.prototypes.copy_(F.normalize(self.prototypes, dim=1))"),
        ("return features @ self.prototypes.transpose(1, 2)", "return features @ F.normalize(self.prototypes, dim=-1).transpose(1, 2)"),
        ("(scores / self.config.temperature).exp()", "(1.02 * scores / self.config.temperature).exp()", "scores.exp()"),
        (
            "            q = q / q.sum(1, keepdim=True)\n            q = q / q.sum(2, keepdim=True)\n",
            "            q = q / q.sum(2, keepdim=True)\n            q = q / q.sum(1, keepdim=True)\n",
        ),
        ("range(self.config.sinkhorn_iterations)", "range(self.config.sinkhorn_iterations + 1)"),
        (
            "F.normalize(self.projector(self.predictor(batch.observation)), dim=-1)",
            "self.projector(self.predictor(batch.observation))",
            "F.normalize(self.projector(self.predictor(batch.observation)), dim=1)",
            "F.normalize(self.projector(self.predictor(batch.next_observation)), dim=-1)",
            "F.normalize(self.projector(self.predictor(batch.observation).detach()), dim=-1) + 0.0 * self.predictor(batch.observation)",
        ),
        (
            "(self.scores(online) / self.config.temperature).log_softmax(-1)",
            "self.scores(online).log_softmax(-1)",
            "(self.scores(online) / self.config.temperature).log_softmax(1)",
        ),
        (
            "self.scores(F.normalize(self.slow_predictor(batch.next_observation), dim=-1))",
            "self.scores(F.normalize(self.predictor(batch.next_observation), dim=-1))",
            "self.scores(F.normalize(self.projector(self.slow_predictor(batch.next_observation)), dim=-1))",
            "self.scores(F.normalize(self.slow_predictor(batch.observation), dim=-1))",
        ),
        ("        with torch.no_grad():\n            q = ", "        with torch.enable_grad():\n            q = "),
        (
            "loss = -(q * log_p).sum(-1).mean(1)",
            "loss = -1.02 * (q * log_p).sum(-1).mean(1)",
            "loss = -(q * log_p).sum(-1).sum(1)",
            "loss = -(q * log_p).mean(-1).mean(1)",
        ),
        (
            "y = self.represent(batch.next_observation)",
            "y = self.represent(batch.observation)",
            "y = self.predictor(batch.next_observation)",
            "y = F.normalize(self.slow_predictor(batch.next_observation), dim=-1)",
            "y = F.normalize(self.projector(self.predictor(batch.next_observation)), dim=-1)",
        ),
        ("return F.normalize(self.predictor(observation), dim=-1)", "return F.normalize(self.predictor(observation), dim=1)"),
        (
            "        self._remember(y)\n        nearest = neighbour_distances(y, self.config.neighbours, among=self.queue)\n",
            "        nearest = neighbour_distances(y, self.config.neighbours, among=self.queue)\n        self._remember(y)\n",
        ),
        ("among=self.queue", "among=torch.cat([self.queue, y], dim=1)"),
        ("return nearest.amax(-1)", "return nearest.mean(-1)", "return nearest.amax(-1).log1p()", "return nearest.amin(-1)"),
        (
            "self.scores(y).transpose(1, 2).softmax(-1)",
            "self.scores(y).softmax(-1).transpose(1, 2)",
            "(self.scores(y) / self.config.temperature).transpose(1, 2).softmax(-1)",
        ),
        ("(self.queue_start + torch.arange", "(self.queue_start + 1 + torch.arange"),
        ("self.queue_start.add_(config.prototypes)", "self.queue_start.add_(0)"),
        (
            "soft_update(self.predictor, self.slow_predictor, self.config.encoder_tau)",
            "soft_update(self.predictor, self.slow_predictor, self.config.critic_tau)",
            "soft_update(self.slow_predictor, self.predictor, self.config.encoder_tau)",
        ),
        ("return [self.predictor, self.projector, self.prototypes]", "return [self.predictor, self.projector]"),
        ("temperature: PositiveFloat = 0.1", "temperature: PositiveFloat = 0.2"),
        ("neighbours: PositiveInt = 3", "neighbours: PositiveInt = 4"),
        ("sinkhorn_iterations: PositiveInt = 3", "sinkhorn_iterations: PositiveInt = 2"),
        ("encoder_tau: UnitInterval = 0.05", "encoder_tau: UnitInterval = 0.01"),
    ),
    # APS
    *mutants(
        "collectors/aps.py", ("aps",),
        (
            "        loss = -aligned.mean(1)\n",
            "        loss = -1.02 * aligned.mean(1)\n",
            "        loss = aligned.mean(1)\n",
            "        loss = -aligned.sum(1)\n",
        ),
        (
            "F.normalize(self.features(batch.next_observation), dim=-1)",
            "F.normalize(self.features(batch.observation), dim=-1)",
            "self.features(batch.next_observation)",
            "F.normalize(self.features(batch.next_observation), dim=1)",
        ),
        (
            "config, features = self.config, self.represent(batch.next_observation)",
            "config, features = self.config, self.represent(batch.observation)",
        ),
        ("neighbour_distances(features, config", "neighbour_distances(F.normalize(features, dim=-1), config"),
        (
            "        self.moments.add(distances)\n        entropy = normalised_entropy_reward(distances, self.moments.mean, ",
            "        before = self.moments.mean.clone()\n"
            "        self.moments.add(distances)\n        entropy = normalised_entropy_reward(distances, before, ",
        ),
        ("self.moments.add(distances)", "self.moments.add(distances.mean(-1))"),
        ("distances, self.moments.mean, config", "distances, self.moments.variance.sqrt(), config"),
        (
            "return entropy + (skill_of(batch) * F.normalize(features, dim=-1)).sum(-1)",
            "return entropy + (skill_of(batch) * features).sum(-1)",
            "return entropy - (skill_of(batch) * F.normalize(features, dim=-1)).sum(-1)",
            "return entropy + 1.02 * (skill_of(batch) * F.normalize(features, dim=-1)).sum(-1)",
            "return 1.02 * entropy + (skill_of(batch) * F.normalize(features, dim=-1)).sum(-1)",
        ),
        (
            "(successor * skill[:, :, None]).sum(-1)",
            "(successor * skill[:, :, None]).mean(-1)",
            "(successor * skill[:, :, None]).sum(-1).mean(-1, keepdim=True).expand(-1, -1, 2)",
        ),
        ("neighbours: PositiveInt = 12", "neighbours: PositiveInt = 11"),
        ("distance_floor: NonNegativeFloat = 1e-4", "distance_floor: NonNegativeFloat = 0.0"),
    ),
    # RND
    *mutants(
        "collectors/rnd.py", ("rnd",),
        ("_EPSILON = 1e-5", "_EPSILON = 1e-3"),
        ("observation = batch.observation\n", "observation = batch.next_observation\n"),
        ("unbiased=False)", "unbiased=True)"),
        ("dim=1, keepdim=True, unbiased", "dim=(0, 1), keepdim=True, unbiased"),
        (".clamp(-clip, clip)", "", ".clamp(-clip, 1.02 * clip)", ".clamp(-1.02 * clip, clip)"),
        (".square().mean(-1)", ".square().sum(-1)", ".norm(dim=-1)", ".square().mean(1, keepdim=True).mean(-1).expand(-1, 20)"),
        ('batch.cache["target"] - self.predictor', '1.02 * batch.cache["target"] - self.predictor'),
        ("loss = self.error(batch).mean(1)", "loss = 1.02 * self.error(batch).mean(1)", "loss = self.error(batch).sum(1)"),
        (
            "        self.moments.add(error)\n        return self.config.reward_scale * error / (self.moments.variance.sqrt()",
            "        before = self.moments.variance.clone()\n"
            "        self.moments.add(error)\n        return self.config.reward_scale * error / (before.sqrt()",
        ),
        ("* error / (self.moments", "* (error - self.moments.mean[:, None]) / (self.moments"),
        ("(self.moments.variance.sqrt() + 1e-8)", "(self.moments.variance + 1e-8)", "(self.moments.mean + 1e-8)"),
        ("self.config.reward_scale * error", "1.02 * self.config.reward_scale * error"),
        ("return [self.predictor]", "return [self.predictor, self.random_network.requires_grad_(True)]"),
        ("observation_clip: PositiveFloat = 5.0", "observation_clip: PositiveFloat = 4.0"),
        ("reward_scale: PositiveFloat = 1.0", "reward_scale: PositiveFloat = 0.5"),
    ),
    survivor(
        "collectors/rnd.py", ("rnd",),
        ".requires_grad_(False)\n",
        "\n",
        "the random network is in no optimiser, and nobody looks at its gradient",
    ),
    # Disagreement
    *mutants(
        "collectors/disagreement.py", ("disagreement",),
        (
            ".norm(dim=-1).mean((1, 2))",
            ".norm(dim=-1).sum((1, 2))",
            ".norm(dim=-1).sum(1).mean(1)",
            ".square().sum(-1).mean((1, 2))",
            ".norm(dim=-1).amax(1).mean(1)",
        ),
        (
            "loss = (batch.next_observation[:, None] - self.predictions(batch))",
            "loss = 1.02 * (batch.next_observation[:, None] - self.predictions(batch))",
            "loss = (batch.next_observation[:, None] - self.predictions(batch).mean(1, keepdim=True).expand(-1, "
            "self.config.models, -1, -1))",
        ),
        (
            ".var(dim=1).mean(-1)",
            ".var(dim=1, unbiased=False).mean(-1)",
            ".var(dim=1).sum(-1)",
            ".std(dim=1).mean(-1)",
            ".var(dim=1).mean(-1).log1p()",
            ".var(dim=2, keepdim=True).mean((1, 3)).expand(-1, 20)",
        ),
        ("torch.cat([batch.observation, batch.action], dim=-1)", "torch.cat([batch.next_observation, batch.action], dim=-1)"),
        ("orthogonal=False", "orthogonal=True"),
    ),
    # DIAYN, and what SMM shares with it
    *mutants(
        "collectors/diayn.py", ("diayn",),
        ("logits, skill = self.discriminator(batch.next_observation)", "logits, skill = self.discriminator(batch.observation)"),
        (
            "loss = skill_cross_entropy(logits, skill).mean(1)",
            "loss = 1.02 * skill_cross_entropy(logits, skill).mean(1)",
            "loss = skill_cross_entropy(logits, skill).sum(1)",
        ),
        (".float().mean(1)\n        return loss", ".float().sum(1)\n        return loss"),
        ("        logits = self.discriminator(batch.next_observation)\n", "        logits = self.discriminator(batch.observation)\n"),
        (
            "return math.log(self.config.skills) - skill_cross",
            "return -math.log(self.config.skills) - skill_cross",
            "return math.log(self.config.skills) + skill_cross",
            "return math.log(self.config.skills) - 1.02 * skill_cross",
            "return -skill_cross",
        ),
    ),
    *mutants(
        "collectors/diayn.py", ("diayn", "smm"),
        (
            "-(logits.log_softmax(-1) * skill).sum(-1)",
            "-(logits.log_softmax(1) * skill).sum(-1)",
            "-(logits * skill).sum(-1)",
            "-(logits.log_softmax(-1) * skill).mean(-1)",
        ),
    ),
    # SMM
    *mutants(
        "collectors/smm.py", ("smm",),
        ("seen = torch.cat([batch.observation, skill], dim=-1)", "seen = torch.cat([batch.next_observation, skill], dim=-1)"),
        ("mean, log_variance = self.encoder(seen).chunk(2, dim=-1)", "log_variance, mean = self.encoder(seen).chunk(2, dim=-1)"),
        (
            "mean + (0.5 * log_variance).exp() * noise",
            "mean + log_variance.exp() * noise",
            "mean + (0.5 * log_variance).exp()",
            "mean + (0.5 * log_variance).exp().detach() * noise",
            "mean",
        ),
        (
            "divergence = 0.5 * (log_variance.exp() + mean.square() - 1.0 - log_variance)",
            "divergence = (log_variance.exp() + mean.square() - 1.0 - log_variance)",
            "divergence = 0.5 * (log_variance.exp() + mean.square() - 1.0 + log_variance)",
            "divergence = 0.5 * (log_variance.exp() + mean.abs() - 1.0 - log_variance)",
        ),
        ("- 1.0 - log_variance).sum(-1)", "- 1.0 - log_variance).mean(-1)"),
        ("self.discriminator(batch.observation), skill", "self.discriminator(batch.next_observation), skill"),
        (
            '"novelty": squared.detach().sum(-1)',
            '"novelty": squared.detach().mean(-1)',
            '"novelty": squared.detach()[..., : -self.config.skills].sum(-1)',
        ),
        (
            '"loss_reconstruction": squared.mean((1, 2))',
            '"loss_reconstruction": squared.sum(-1).mean(1)',
            '"loss_reconstruction": 1.02 * squared.mean((1, 2))',
        ),
        (
            "self.config.kl_weight * divergence.mean(1)",
            "1.02 * self.config.kl_weight * divergence.mean(1)",
            "divergence.mean(1)",
            "self.config.kl_weight * divergence.sum(1)",
        ),
        ('"loss_discriminator": unrecognised.mean(1)', '"loss_discriminator": unrecognised.sum(1)'),
        ('losses["loss_divergence"] + losses["loss_discriminator"]\n', 'losses["loss_divergence"] + 1.02 * losses["loss_discriminator"]\n'),
        (
            "constant = config.latent_weight * math.log(config.skills)",
            "constant = -config.latent_weight * math.log(config.skills)",
            "constant = math.log(config.skills)",
        ),
        ('config.novelty_weight * kept["novelty"]', 'kept["novelty"]'),
        (
            'config.discriminator_weight * kept["unrecognised"]',
            '-config.discriminator_weight * kept["unrecognised"]',
            '1.02 * config.discriminator_weight * kept["unrecognised"]',
        ),
        ("(self.discriminator, config.discriminator_learning_rate)", "(self.discriminator, rate)"),
        ("(self.decoder, rate)", "(self.decoder, config.discriminator_learning_rate)"),
        ("2 * config.latent_dim, blocks=2)", "2 * config.latent_dim)"),
        ("kl_weight: NonNegativeFloat = 0.5", "kl_weight: NonNegativeFloat = 1.0"),
        ("discriminator_weight: Finite = 1.0", "discriminator_weight: Finite = -1.0"),
        ("vae_learning_rate: PositiveFloat = 1e-2", "vae_learning_rate: PositiveFloat = 1e-3"),
    ),
    # CIC
    *mutants(
        "collectors/cic.py", ("cic",),
        ("torch.cat([batch.observation, batch.next_observation], dim=1)", "torch.cat([batch.next_observation, batch.observation], dim=1)"),
        (
            "keys = F.normalize(self.pair_network(torch.cat(both.split(size, dim=1), dim=-1)), dim=-1)",
            "keys = self.pair_network(torch.cat(both.split(size, dim=1), dim=-1))",
            "keys = F.normalize(self.pair_network(torch.cat(both.split(size, dim=1), dim=-1)), dim=1)",
            "keys = F.normalize(self.pair_network(torch.cat(both.split(size, dim=1), dim=-1).detach()), dim=-1) + 0.0 * both.sum()",
        ),
        (
            "queries = F.normalize(self.skill_network(skill_of(batch)), dim=-1)",
            "queries = F.normalize(skill_of(batch) + 0.0 * self.skill_network(skill_of(batch)), dim=-1)",
        ),
        ("/ self.config.temperature", "/ (1.02 * self.config.temperature)", "* self.config.temperature"),
        ("others = similarity.masked_fill(torch.eye(size, dtype=torch.bool, device=self.device), -torch.inf)", "others = similarity"),
        (
            "loss = (others.logsumexp(-1) - own).mean(1)",
            "loss = (others.logsumexp(1) - own).mean(1)",
            "loss = (others.logsumexp(-1) - own).sum(1)",
            "loss = 1.02 * (others.logsumexp(-1) - own).mean(1)",
            "loss = (others.logsumexp(-1) - own.detach()).mean(1)",
            "loss = (others.exp().mean(-1).log() - own).mean(1)",
        ),
        (
            "self.represent(batch.next_observation), config",
            "self.represent(batch.observation), config",
            "F.normalize(self.represent(batch.next_observation), dim=-1), config",
        ),
        (
            "        self.moments.add(distances)\n        return normalised_entropy_reward(distances, self.scale,",
            "        before = self.scale.clone()\n"
            "        self.moments.add(distances)\n        return normalised_entropy_reward(distances, before,",
        ),
        (
            'return self.moments.variance if self.config.normalise_by == "variance"',
            'return self.moments.mean if self.config.normalise_by == "variance"',
        ),
        ("else self.moments.variance.sqrt()", "else self.moments.variance"),
        ("return [self.state_network, self.pair_network, self.skill_network]", "return [self.state_network, self.pair_network]"),
        ("temperature: PositiveFloat = 0.5", "temperature: PositiveFloat = 0.1"),
        ("neighbours: PositiveInt = 16", "neighbours: PositiveInt = 12"),
        ("distance_floor: NonNegativeFloat = 5e-4", "distance_floor: NonNegativeFloat = 1e-4"),
        ('normalise_by: Literal["variance", "std"] = "variance"', 'normalise_by: Literal["variance", "std"] = "std"'),
    ),
    # MOSS, and what CIC leaves to it
    *mutants(
        "collectors/moss.py", ("moss",),
        (
            'states, following = batch.cache["states"]',
            'following, states = batch.cache["states"]',
            "states, following = self.represent(batch.observation), self.represent(batch.next_observation)",
            'states, following = (batch.cache["states"][1],) * 2',
        ),
        ("config.knn_exclude_self, among=following)", "config.knn_exclude_self)", "False, among=following)"),
        ("self.moments.add(distances)", "self.moments.add(distances.mean(-1))"),
        (
            "distances - self.moments.mean[:, None, None], self.scale",
            "distances, self.scale",
            "distances - self.moments.mean.mean(), self.scale",
            "distances - distances.mean((1, 2))[:, None, None], self.scale",
            "distances - self.moments.mean[:, None, None], self.scale.sqrt()",
        ),
        (
            "        self.moments.add(distances)\n        entropy = normalised_entropy_reward(distances - self.moments.mean[",
            "        before = self.moments.mean.clone()\n"
            "        self.moments.add(distances)\n        entropy = normalised_entropy_reward(distances - before[",
        ),
        (
            "torch.where(skill_of(batch)[..., 0] > 0, entropy, -entropy)",
            "torch.where(skill_of(batch)[..., 0] > 0, -entropy, entropy)",
            "entropy",
            "torch.where(skill_of(batch)[..., 0] > 0, entropy, 0.0)",
            "torch.where(skill_of(batch)[..., 0] > 0.5, entropy, -entropy)",
            "torch.where(skill_of(batch)[:, :1, 0] > 0, entropy, -entropy)",
        ),
        ("= 32", "= 64"),
        ("= 2.0", "= 4.0"),
        ('Literal["half", "sign"] = "half"', 'Literal["half", "sign"] = "sign"'),
    ),
    # C-TeC
    *mutants(
        "collectors/ctec.py", ("ctec",),
        (
            "self.pair_encoder(torch.cat([batch.observation, batch.action], dim=-1)), dim=-1)",
            "self.pair_encoder(torch.cat([batch.observation, batch.action], dim=-1)), dim=1)",
            "self.pair_encoder(torch.cat([batch.next_observation, batch.action], dim=-1)), dim=-1)",
        ),
        ("return F.normalize(self.state_encoder(observation), dim=-1)", "return self.state_encoder(observation)"),
        ("(-self.log_temperature).exp()", "self.log_temperature.exp()", "(-self.log_temperature.detach()).exp()", "1.0"),
        (
            "self.represent(batch.future_observation)",
            "self.represent(batch.next_observation)",
            "self.represent(batch.future_observation).detach()",
        ),
        ("p=1.0", "p=2.0"),
        ("(-distances).logsumexp(-1)", "(-distances).logsumexp(1)", "distances.logsumexp(-1)"),
        (
            "= own.detach()",
            "= -own.detach()",
            "= (own + log_sum).detach()",
            "= 1.02 * own.detach()",
            "= own.mean(1, keepdim=True).expand_as(own).detach()",
        ),
        (
            "(log_sum + own).mean(1)",
            "(log_sum - own).mean(1)",
            "(log_sum + own).sum(1)",
            "1.02 * (log_sum + own).mean(1)",
            "(log_sum + own.detach()).mean(1)",
        ),
        (
            "log_sum.square().mean(1)",
            "log_sum.mean(1)",
            "log_sum.mean(1).square()",
            "log_sum.square().sum(1)",
            "log_sum.detach().square().mean(1)",
        ),
        ("width, width, size)\n        self.state", "width, size)\n        self.state"),
        ("return [self.pair_encoder, self.state_encoder, self.log_temperature]", "return [self.pair_encoder, self.state_encoder]"),
        ("logsumexp_weight: NonNegativeFloat = 0.1", "logsumexp_weight: NonNegativeFloat = 0.0"),
        ("embedding_dim: PositiveInt = 64", "embedding_dim: PositiveInt = 32"),
    ),
    # METRA
    *mutants(
        "collectors/metra.py", ("metra",),
        (
            "torch.cat([batch.observation, batch.next_observation], dim=1)",
            "torch.cat([batch.next_observation, batch.observation], dim=1)",
        ),
        (
            "skill = (skill - skill.mean(-1, keepdim=True)) * size / (size - 1)",
            "skill = skill - skill.mean(-1, keepdim=True)",
            "skill = skill * size / (size - 1)",
            "skill = (skill - skill.mean(1, keepdim=True)) * size / (size - 1)",
        ),
        ("if self.config.discrete:", "if not self.config.discrete:"),
        ("(steps * skill).sum(-1)", "(steps * skill).mean(-1)", "1.02 * (steps * skill).sum(-1)"),
        (
            "(1.0 - steps.square().mean(-1))",
            "(1.0 - steps.square().sum(-1))",
            "(1.02 - steps.square().mean(-1))",
            "(1.0 - steps.norm(dim=-1))",
            "(steps.square().mean(-1) - 1.0)",
        ),
        (".clamp(max=self.config.slack)", "", ".clamp(max=0.0)", ".clamp(min=self.config.slack)"),
        ("self.log_multiplier[:, 0].detach().exp()", "self.log_multiplier[:, 0].exp()", "self.log_multiplier[:, 0].detach()"),
        (
            "+ multiplier * kept)",
            "- multiplier * kept)",
            "+ kept)",
            "+ multiplier * kept.detach())",
            "+ multiplier * kept.mean(1, keepdim=True).clamp(max=0.0))",
        ),
        ("* kept).mean(1)", "* kept).sum(1)"),
        (
            "self.log_multiplier[:, 0, 0] * kept.detach().mean(1)",
            "-self.log_multiplier[:, 0, 0] * kept.detach().mean(1)",
            "self.log_multiplier[:, 0, 0] * kept.mean(1)",
            "self.log_multiplier[:, 0, 0].exp() * kept.detach().mean(1)",
            "self.log_multiplier[:, 0, 0] * kept.detach().sum(1)",
            "self.log_multiplier[:, 0, 0] * kept.detach().mean()",
        ),
        ("return loss + dual,", "return loss,"),
        (
            "return self.along(self.steps(batch), skill_of(batch))",
            "return -self.along(self.steps(batch), skill_of(batch))",
            "return self.along(self.steps(batch), skill_of(batch)) - self.steps(batch).square().mean(-1)",
        ),
        ("width, width, self.config.skill_dim)", "width, self.config.skill_dim)"),
        ("return [self.state_network, self.log_multiplier]", "return [self.state_network]"),
        ("horizon: PositiveInt = 1", "horizon: PositiveInt = 3"),
        ("slack: NonNegativeFloat = 1e-3", "slack: NonNegativeFloat = 1e-2"),
        ("multiplier: PositiveFloat = 30.0", "multiplier: PositiveFloat = 10.0"),
        ("math.log(self.config.multiplier)", "self.config.multiplier"),
        ("= 4\n", "= 2\n"),
    ),
]  # fmt: skip

CUDC = [
    # φ_s, φ_a, f_s, f_a, f_k, and what they see
    *mutants(
        "collectors/cudc.py", ("cudc", "cudc-no-inverse", "cudc-no-reach"),
        ("LayerNorm(random, z), Activation(torch.tanh))", "LayerNorm(random, z))"),
        ("mlp(random, size, width, z), LayerNorm", "mlp(random, size, width, z, output=torch.relu), LayerNorm"),
        ("self.action_encoder(batch.action) if", "self.action_encoder(batch.action).tanh() if"),
        (
            "torch.cat([z, action, k], dim=-1)",
            "torch.cat([z.detach(), action, k], dim=-1)",
            "torch.cat([z, action.detach(), k], dim=-1)",
            "torch.cat([z, action, 0.0 * k], dim=-1)",
            "torch.cat([z_next, action, k], dim=-1)",
        ),
        (
            "batch.horizon[:, None] - config.horizon == torch",
            "batch.horizon[:, None] - config.horizon - 1 == torch",
            "self.k[:, None] - config.horizon == torch",
        ),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc", "cudc-literal", "cudc-no-reach"),
        ("torch.cat([z_pair, k], dim=-1)", "torch.cat([z_pair, 0.0 * k], dim=-1)", "torch.cat([z_pair.detach(), k], dim=-1)"),
        (
            "z_pair = torch.cat([z, z_next], dim=-1)",
            "z_pair = torch.cat([z_next, z], dim=-1)",
            "z_pair = torch.cat([z, z_next.detach()], dim=-1)",
            "z_pair = torch.cat([z.detach(), z_next], dim=-1)",
        ),
        ("if nearer else z_pair)", "if nearer else z_pair.detach())"),
        (
            "(target - f.inverse).norm(dim=-1).mean(1)",
            "1.02 * (target - f.inverse).norm(dim=-1).mean(1)",
            "(target - f.inverse).square().sum(-1).mean(1)",
            "(target - f.inverse).norm(dim=-1).sum(1)",
        ),
        ('reduction="none").mean(1)', 'reduction="none").sum(1)', 'reduction="none").mean(1) * 1.02'),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc",),
        ('if config.action_target == "live" else f.action.detach()', 'if config.action_target == "live" else f.action'),
        ('f.action if config.action_target == "live"', 'f.action.detach() if config.action_target == "live"'),
        ("            state_target = state_target.detach()\n", "            pass\n"),
        (
            'f.momentum if config.state_target == "momentum" else f.z_next',
            "f.z_next",
            'f.z_next if config.state_target == "momentum" else f.momentum',
        ),
        ("z_next, *nearer = self.state_encoder", "z_next, *nearer = self.momentum_encoder"),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc-vary-icm", "cudc-vary-apt", "cudc-reward"),
        ("width, self.sizes.action, output=torch.tanh)", "width, self.sizes.action)"),
        ("else batch.action\n            losses", "else 1.02 * batch.action\n            losses"),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc-kmix",),
        ("torch.cat([z, nearer[0]], dim=-1)", "torch.cat([z_next, nearer[0]], dim=-1)", "torch.cat([z, nearer[0].detach()], dim=-1)"),
        ("if batch.nearer_horizon is None else batch.nearer_horizon", "if True else batch.nearer_horizon"),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc", "cudc-vary-icm", "cudc-vary-apt", "cudc-reward", "cudc-no-reach", "cudc-no-inverse"),
        (
            "(state_target - f.predicted).norm(dim=-1).mean(1)",
            "1.02 * (state_target - f.predicted).norm(dim=-1).mean(1)",
            "(state_target - f.predicted).square().sum(-1).mean(1)",
            "(state_target - f.predicted).norm(dim=-1).sum(1)",
            "(state_target - f.z - f.predicted).norm(dim=-1).mean(1)",
        ),
        (
            "f.surprise = (f.z_next - f.predicted).norm(dim=-1)",
            "f.surprise = 1.02 * (f.z_next - f.predicted).norm(dim=-1)",
            "f.surprise = (f.z_next - f.predicted).square().sum(-1)",
            "f.surprise = (f.z - f.predicted).norm(dim=-1)",
        ),
        ("if self.config.reward_after_update:", "if not self.config.reward_after_update:"),
        ("zip(_LOSSES, config.loss_weights, strict=True)", "zip(_LOSSES, (1.02, 1.0, 1.0, 1.0), strict=True)"),
        ('"step_norm": (f.z_next - f.z)', '"step_norm": (f.predicted - f.z)'),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc",),
        (
            "zip(_LOSSES, config.loss_weights, strict=True)",
            "zip(_LOSSES, reversed(config.loss_weights), strict=True)",
            "zip(_LOSSES, (1.0, 1.0, 1.0, 1.0), strict=True)",
        ),
        ('_LOSSES = ("loss_forward", "loss_inverse",', '_LOSSES = ("loss_inverse", "loss_forward",'),
    ),
    # Reachability and curiosity
    *mutants(
        "collectors/cudc.py", ("cudc", "cudc-reach", "cudc-no-inverse", "cudc-literal"),
        (
            "queries = self.projection(predicted)",
            "queries = self.projection(predicted.detach())",
            "queries = self.momentum_projection(predicted) + 0.0 * self.projection(predicted)",
            "queries = F.normalize(self.projection(predicted), dim=-1)",
            "queries = self.projection(z_next)",
        ),
        (
            "keys = self.momentum_projection(found.momentum)",
            "keys = self.projection(found.momentum)",
            "keys = self.momentum_projection(z_next)",
        ),
        (
            "found.momentum = self.momentum_encoder(batch.next_observation)",
            "found.momentum = self.momentum_encoder(batch.observation)",
            "found.momentum = self.state_encoder(batch.next_observation)",
        ),
        ("with torch.no_grad():\n            keys", "with torch.enable_grad():\n            found.momentum = z_next\n            keys"),
        (
            "logits = torch.bmm(torch.bmm(queries, self.similarity), keys",
            "logits = torch.bmm(torch.bmm(queries, self.similarity.transpose(1, 2)), keys",
            "logits = torch.bmm(queries + 0.0 * torch.bmm(queries, self.similarity), keys",
        ),
        (
            "logits.diagonal(dim1=1, dim2=2), logits.logsumexp(-1)",
            "logits.diagonal(dim1=1, dim2=2), logits.logsumexp(1)",
            "logits.diagonal(dim1=1, dim2=2), logits.logsumexp((1, 2))[:, None]",
            "logits.diagonal(dim1=1, dim2=2), logits.logsumexp(-1).detach()",
        ),
        ("found.log_reachable = own - all_keys", "found.log_reachable = 1.02 * (own - all_keys)"),
        (
            'losses["loss_reach"] = -f.log_reachable.mean(1)',
            'losses["loss_reach"] = -f.log_reachable.sum(1)',
            'losses["loss_reach"] = -1.02 * f.log_reachable.mean(1)',
        ),
        ("self.similarity = nn.Parameter(self._first", "self.similarity = nn.Parameter(requires_grad=True, data=2.0 * self._first"),
        (
            "-torch.expm1(f.log_found)",
            "-1.02 * torch.expm1(f.log_found)",
            "-torch.expm1(1.02 * f.log_found)",
            "-f.log_found",
        ),
        (
            "soft_update(self.projection, self.momentum_projection, self.config.momentum_tau)",
            "soft_update(self.projection, self.momentum_projection, self.config.critic_tau)",
        ),
        (
            "soft_update(self.state_encoder, self.momentum_encoder, self.config.momentum_tau)",
            "soft_update(self.state_encoder, self.momentum_encoder, self.config.critic_tau)",
            "soft_update(self.momentum_encoder, self.state_encoder, self.config.momentum_tau)",
        ),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc",),
        ("older.masked_fill(~there, -torch.inf)", "older"),
        (
            "torch.arange(older.shape[-1], device=older.device) < self.keys_seen",
            "torch.arange(older.shape[-1], device=older.device) <= self.keys_seen",
        ),
        ("keys = f.keys[:, :size]", "keys = f.keys.flip(1)[:, :size]"),
        ("-torch.expm1(f.log_found)", "-torch.expm1(f.log_reachable)"),
        (", keys.transpose(1, 2)) / config.temperature", ", keys.transpose(1, 2)) * config.temperature"),
        ("self.older_keys.transpose(1, 2)) / config.temperature", "self.older_keys.transpose(1, 2))"),
        ("torch.arange(keys.shape[1], device=self.device)) % size", "torch.arange(keys.shape[1], device=self.device)) % size * 0"),
        ("self.keys_seen.add_(keys.shape[1])", "self.keys_seen.add_(1)"),
        ("max((config.keys or 0) - config.batch_size, 0)", "max((config.keys or 0) - 1, 0)"),
        ("            keys = f.keys[:, :size]\n", "            keys = self.projection(f.predicted)[:, :size]\n"),
        ("w / w.mean(1, keepdim=True)", "w / w.mean()", "w / w.sum(1, keepdim=True)", "w / w.amax(1, keepdim=True)"),
        (
            "w.clamp(self.config.clip_low, self.config.clip_high)",
            "w.clamp(self.config.clip_low)",
            "w.clamp(1.02 * self.config.clip_low, self.config.clip_high)",
            "w.clamp(max=self.config.clip_high)",
        ),
        ("        w = f.w = ", "        w = f.w = 0.0 * f.log_reachable + 1.0 - "),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc-reach", "cudc-no-regularize"),
        ("if not self.config.regularize:\n            return None", "if not self.config.regularize:\n            return w"),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc-no-reach", "cudc-reward", "cudc-vary-icm"),
        (
            "if not self.config.reach:\n            return None\n        f = features_of(batch)\n",
            "f = features_of(batch)\n        if not self.config.reach:\n            return f.surprise\n",
        ),
    ),
    # Reward
    *mutants(
        "collectors/cudc.py", ("cudc", "cudc-no-pe", "cudc-no-inverse", "cudc-reward"),
        (
            "torch.cat([f.z, f.action], dim=-1) if",
            "torch.cat([f.z_next, f.action], dim=-1) if",
            "torch.cat([f.z, batch.action], dim=-1) if",
            "f.z if",
        ),
        (
            "config.knn_exclude_self).mean(-1).log1p()",
            "config.knn_exclude_self).mean(-1)",
            "config.knn_exclude_self).amax(-1).log1p()",
            "config.knn_exclude_self).log1p().mean(-1)",
            "config.knn_exclude_self).mean(-1).log1p() * 1.02",
        ),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc-vary-apt",),
        (
            "if config.action_encoder else f.z\n",
            "if config.action_encoder else f.z_next\n",
            "if config.action_encoder else torch.cat([f.z, f.action], dim=-1)\n",
        ),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc", "cudc-no-entropy", "cudc-no-reach"),
        (
            "config.alpha * f.surprise if config.prediction",
            "1.02 * config.alpha * f.surprise if config.prediction",
            "f.surprise if config.prediction",
        ),
        (
            "torch.full_like(f.surprise, config.beta)",
            "torch.full_like(f.surprise, 1.02 * config.beta)",
            "torch.zeros_like(f.surprise)",
        ),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc-vary-icm",),
        ("else f.surprise.log1p())", "else f.surprise)"),
    ),
    # k
    *mutants(
        "collectors/horizon.py", ("cudc", "cudc-vary-icm", "cudc-no-reach"),
        ("low > config.c_k", "low < config.c_k"),
        ("grow = (self.in_a_row >= config.patience) & dwelt", "grow = (self.in_a_row > config.patience) & dwelt"),
        (
            "(self.updates - self.last_change) * self.sizes.update_every >= dwell",
            "(self.updates - self.last_change) >= dwell",
            "(self.updates - self.last_change) * self.sizes.update_every > dwell",
        ),
        ("self.k += grow", "self.k += 2 * grow", "self.k += grow.any()"),
        (
            "getattr(config, _THRESHOLDS[config.k_rule])).float().mean(1)",
            "getattr(config, _THRESHOLDS[config.k_rule])).float().mean()[None].expand(2)",
            "1.02 * getattr(config, _THRESHOLDS[config.k_rule])).float().mean(1)",
        ),
        ("self._adapt_horizon(low, signal.mean(1))", "self._adapt_horizon(low, signal.median(1).values)"),
    ),
    *mutants(
        "collectors/horizon.py", ("cudc-kmax4",),
        (" & (self.k < config.k_max)", " & (self.k <= config.k_max)"),
    ),
    *mutants(
        "collectors/horizon.py", ("cudc",),
        ("self.last_change.copy_(torch.where(grow, self.updates, self.last_change))", "pass"),
    ),
    *mutants(
        "collectors/cudc.py", ("cudc",),
        ('{"weight": "w", "reward"', '{"weight": "unclipped", "reward"'),
    ),
    *mutants(
        "collectors/horizon.py", ("cudc-vary-icm", "cudc-no-reach", "cudc-reward"),
        ("config.threshold_dwell if self.measured_by_pilot(config) else 0", "0"),
    ),
    *mutants(
        "collectors/horizon.py", ("cudc-uniform-k", "cudc-normal-k"),
        ("self.k.copy_(self._drawn_horizon())", "pass"),
    ),
    *mutants(
        "collectors/horizon.py", ("cudc-uniform-k",),
        ("uniform() * self.horizons).long()", "uniform() * (self.horizons - 1)).long()", "uniform() * self.horizons).round().long()"),
    ),
    *mutants(
        "collectors/horizon.py", ("cudc-normal-k",),
        ("(self.updates + 1) * self.sizes.update_every\n            mean", "self.updates * self.sizes.update_every\n            mean"),
        ("(config.k_max - config.horizon) * steps", "(config.k_max - config.horizon + 1) * steps"),
        ("(mean + config.normal_std * self", "(mean + self"),
        (".round().long()", ".long()"),
    ),
    # What it says of itself
    *mutants(
        "collectors/cudc.py", ("cudc", "cudc-no-inverse"),
        ('"w_q10": 0.10', '"w_q10": 0.11'),
        ("f.unclipped < config.clip_low", "f.unclipped > config.clip_low"),
        ("logits.detach().argmax(-1) == label", "logits.detach().argmax(1) == label"),
        ("self.probe.copy_(batch.observation)", "self.probe.copy_(batch.next_observation)"),
        ("if not self.probe.any():", "if True:"),
        ('config.alpha * found["surprise"] / found["entropy"]', 'found["surprise"] / found["entropy"]'),
        ('found["surprise"] / found["step_norm"]', 'found["step_norm"] / found["surprise"]'),
    ),
    *mutants(
        "collectors/representation.py", ("cudc", "cudc-no-inverse"),
        ("features - features.mean(1, keepdim=True)", "features"),
        ("features.std(1)", "features.std(1, unbiased=False)"),
        ("(parts[0] + parts[1]).topk", "parts[0].topk"),
        ("return of_action / (of_state + of_action)", "return of_action / of_state"),
    ),
    # Numbers of the paper
    *mutants(
        "collectors/cudc.py", ("cudc",),
        ("neighbours: PositiveInt = 12", "neighbours: PositiveInt = 11"),
        ("c_k: UnitInterval = 0.5", "c_k: UnitInterval = 0.4"),
        ("momentum_tau: UnitInterval = 0.05", "momentum_tau: UnitInterval = 0.01"),
        ("temperature: PositiveFloat = 1.0", "temperature: PositiveFloat = 0.5"),
        ("keys: PositiveInt | None = field(default=None", "keys: PositiveInt | None = field(default=1024"),
        (
            'state_target: Literal["live", "stopgrad", "momentum"] = "stopgrad"',
            'state_target: Literal["live", "stopgrad", "momentum"] = "live"',
            'state_target: Literal["live", "stopgrad", "momentum"] = "momentum"',
        ),
        ('action_target: Literal["stopgrad", "live"] = "stopgrad"', 'action_target: Literal["stopgrad", "live"] = "live"'),
        (
            '"walker": {"alpha": 1e-3, "beta": 1e-2, "clip_low": 0.2, "clip_high": 2.0',
            '"walker": {"alpha": 1e-3, "beta": 1e-2, "clip_low": 0.2, "clip_high": 1.0',
        ),
        ('"walker": {"alpha": 1e-3,', '"walker": {"alpha": 1e-2,'),
        ("patience: PositiveInt = 1", "patience: PositiveInt = 2"),
    ),
    # Rows of the table of relatives
    *mutants(
        "collectors/variants.py", ("cudc-reach",),
        ('= {"regularize": False}', "= {}"),
    ),
    *mutants(
        "collectors/variants.py", ("cudc-no-entropy",),
        ('= {"entropy": False}', "= {}"),
    ),
    *mutants(
        "collectors/variants.py", ("cudc-no-pe",),
        (
            '{"prediction_error": "none"}\n\n\nclass NoVary',
            '{"prediction_error": "none", "beta": 0.0}\n\n\nclass NoVary',
            "{}\n\n\nclass NoVary",
        ),
    ),
    *mutants(
        "collectors/variants.py", ("cudc-live",),
        ('= {"state_target": "live"}', "= {}", '= {"state_target": "momentum"}'),
    ),
    *mutants(
        "collectors/variants.py", ("cudc-momentum",),
        ('= {"state_target": "momentum"}', "= {}"),
    ),
    *mutants(
        "collectors/variants.py", ("cudc-no-inverse",),
        ('{"inverse": "none", "step_model": False}', '{"inverse": "none"}', '{"step_model": False}'),
    ),
    *mutants(
        "collectors/variants.py", ("cudc-uniform-k",),
        ('{"k_rule": "uniform"}', '{"k_rule": "normal"}'),
    ),
    *mutants(
        "collectors/variants.py", ("cudc-kmix",),
        ('{"inverse_k_batch": "mixed"}', "{}"),
    ),
    *mutants(
        "collectors/variants.py", ("cudc-one-setting",),
        ('"clip_high": 1.0, "c_w": 0.02}', '"clip_high": 1.0, "c_w": 0.01}'),
    ),
    *mutants(
        "collectors/variants.py", ("cudc-literal",),
        ('live", "action_target": "live"}', 'live"}'),
    ),
    *mutants(
        "collectors/variants.py", ("cudc-vary-icm",),
        (
            '"prediction_error": "log", "beta": 0.0, "reward_after_update": True',
            '"prediction_error": "log", "beta": 0.01, "reward_after_update": True',
            '"prediction_error": "log", "beta": 0.0',
        ),
    ),
    *mutants(
        "collectors/variants.py", ("cudc-vary-apt",),
        (
            '"prediction_error": "none", "beta": 0.0, "reward_after_update": True',
            '"prediction_error": "none", "beta": 0.0',
            '"beta": 0.0, "reward_after_update": True',
        ),
        ('"state_target": "live",\n        "prediction_error": "none"', '"prediction_error": "none"'),
    ),
]  # fmt: skip

MUTANTS: list[Mutant] = [*NETWORKS, *AGENT, *LAYERS, *METHODS, *CUDC]
