            for (j = 0; j < CONTROLLER_FORCES; j++)
                sum += L[i * CONTROLLER_FORCES + j] * cut[j];
