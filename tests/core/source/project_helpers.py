"""Functions of a user's project, which the loops of the tests call with their number."""

EVERY = 30
switched_on = False


class Saver:
    """Saves at some numbers, or when it is due by its own account."""

    def __init__(self, every, begin=0):
        self.every, self.begin, self.saved, self.last = every, begin, [], 0

    def step(self, iteration, force=False):
        if iteration < self.begin:
            return
        if force or iteration % self.every == 0:
            self.saved.append(iteration)

    def by_account(self, iteration):
        if iteration - self.last == 20:
            self.last = iteration

    def note(self):
        if self.number % self.every == 0:
            self.saved.append(self.number)


class Trainer:
    """Its loop calls its own methods."""

    def __init__(self):
        self.saver, self.saved = Saver(25), []
        self.number = 0

    def train(self, stop):
        for step in stop(self=self):
            self.number = step
            self.maybe_save(step)
            self.saver.step(iteration=step)
            self.note()

    def maybe_save(self, step):
        if step % EVERY == 0:
            self.saved.append(step)

    def note(self):
        if self.number == 77:
            self.saved.append(self.number)


def log(step):
    write(step + 1)


def write(number, every=EVERY):
    if number % every == 0:
        print(number)


def is_late(step, start=70):
    """Whether a step of every tenth is late."""
    if step < start:
        return False
    every = EVERY // 3
    return step % every == 0


def while_switched_on(step):
    if switched_on and step % 20 == 0:
        print(step)


def switch():
    global switched_on
    switched_on = True
